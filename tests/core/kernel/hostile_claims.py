"""Files of which the kernel cannot make short work: each is decided, or ended by its limits."""

from itertools import product
from typing import Any

from nlsid_core import files, proofs
from nlsid_core.arrays import Json

Claim = tuple[Json, dict[str, Json]]


def hostile() -> dict[str, Claim]:
    """By name: a proof and the files that it is about."""
    return {
        "equal hashes": equal_hashes(14),
        "a large network": network(100),
        "long numbers": long_numbers(100),
    }


def equal_hashes(pairs: int) -> Claim:
    """2^pairs monomials whose packed exponents are equal modulo 2^61 - 1: x_j or x_(j+10)²."""
    n, m = 10, 40
    rows = []
    for choice in product((0, 1), repeat=pairs):
        exponents = [0] * (1 + n + m)
        for pair, other in enumerate(choice):
            exponents[1 + pair + pair // 10 * 10 + 10 * other] = 1 + other
        rows.append(exponents)
    model = {
        "format": "nlsid/model",
        "version": 2,
        "kind": "implicit",
        "period": 1,
        "monotonicity": 1,
        "equation": "0 = h(v, x, w), x+ = [v; shift(x, w)]",
        "inputs": [f"u{i}" for i in range(m)],
        "states": [f"x{i}" for i in range(n)],
        "h": {"exponents": rows, "coefficients": [[1]] * len(rows)},
        "shift": {
            "exponents": [[int(i == j) for j in range(n + m)] for i in range(n)],
            "coefficients": [[int(i == j) for j in range(n - 1)] for i in range(n)],
        },
    }
    witness = {"basis": [[0] * 83], "columns": [0], "squares": {"unit": 0, "factors": [[]]}}
    M = [
        [{"exponents": [[0] * n], "coefficients": [int(i == j)]} for i in range(n)]
        for j in range(n)
    ]
    witnesses = dict.fromkeys(("monotone", "stable", "storage"), witness)
    claim = {"set": "2.11", "delta": 1}
    return bound("stable_set", model, claim, {"inequalities": witnesses, "M": M})


def network(n: int) -> Claim:
    """2^8 matrices of order n + 8."""
    signal = {"name": "s", "unit": "", "path": ""}
    width, m = n + 10, 8
    knots = {"knots": [0, 1, 2], "values": [0, 0.123456789, 0.3]}
    model = {
        "format": "nlsid/model",
        "version": 2,
        "kind": "cell_network",
        "period": 1,
        "training": "",
        "bags": [],
        "y": [signal],
        "u": [signal],
        "maps": [knots] * m,
        "into": [[0] * m + [0.01234567 / (i + j + 1) for j in range(n)] + [0, 0] for i in range(m)],
        "next": [[0.01234567 / (i + j + 3) for j in range(width)] for i in range(n)],
        "output": [[0] * width],
        "start": [0] * n,
        "start_samples": 1,
    }
    P = [[float(i == j) for j in range(n)] for i in range(n)]
    N = [[float(i == j) for j in range(m)] for i in range(m + n)]
    return bound("stability", model, {"rate": 0.9}, {"P": P, "multipliers": {"N": N}})


def long_numbers(n: int) -> Claim:
    """Order n with 1000 bits an entry."""
    signal = {"name": "s", "unit": "", "path": ""}
    model = {
        "format": "nlsid/model",
        "version": 2,
        "kind": "difference_equation",
        "period": 1,
        "training": "",
        "bags": [],
        "y": signal,
        "u": signal,
        "a": [0.1] * n,
        "b": [0] * (n + 1),
        "c": 0,
        "u_range": [0, 1],
    }
    P = [
        [2.0**-900 * (i + j) + (1.0 + 2.0**-40 * i) * (i == j) for j in range(n)] for i in range(n)
    ]
    return bound("stability", model, {"rate": 0.9}, {"P": P})


def bound(kind: str, model: Json, claim: Any, proof: Json) -> Claim:
    """A proof about one model, with its digest."""
    about = {"model": proofs.binding("model.json", model)}
    document = proofs.proof_document({"kind": kind, "about": about, **claim}, proof)
    assert files.encode(document)
    return document, {"model.json": model}
