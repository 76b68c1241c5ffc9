"""A claim about an input of a clipped policy that is held from before its bounds began."""

from itertools import product
from typing import Any

from tests.funnel_files import Files, stated

HOLD, LIMITS = 1.0, (-1.0, 1.0)
TIMES = [0.0, 1.0, 1.25, 2.25]
WANTED = [(0.25, 1.125), (1.125, 3.0), (3.0, 3.0)]  # u₀ at both ends of each interval


def claim(low: float) -> Files:
    """dx/dt = -x, valid for u >= low from 1.25 s on; u = clip(u₀) to [-1, 1], held for 1 s."""
    free, nothing = [[0], [1]], {"unit": 0, "factors": [[]]}
    field = {
        "format": "nlsid/vector_field",
        "version": 2,
        "states": 1,
        "inputs": 1,
        "uncertain": [],
        "breaks": [1.25],
        "valid": [[1, low, 10.0, 1]],
        "expansion": "",
        "pieces": [[{"exponents": [[0, 1, 0]], "coefficients": [-1.0]}]] * 2,
    }
    policy = {
        "format": "nlsid/policy",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "t": TIMES,
        "x": [[[0.0]]] * 3,
        "u": [[[a], [b]] for a, b in WANTED],
        "K": [[[[0.0]]]] * 3,
        "limits": [[0, *LIMITS]],
    }
    funnel = {
        "format": "nlsid/funnel",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "policy": "",
        "t": TIMES,
        "x": [[[0.0]]] * 3,
        "P": [[[1.0]]] * 4,
        "rho": [1.0] * 4,
    }

    def witness(k: int, root: int) -> dict[str, Any]:
        """r is the whole polynomial; τ = root² for what holds in the mode."""
        tau = {"columns": [0, 0], "squares": {"unit": 0, "factors": [[[root, 0]]]}}
        return {
            "interval": k,
            "level": 0,
            "index": 0,
            "columns": [0, 0],
            "squares": nothing,
            "tau": [tau],
        }

    lengths = [[int(4 * (TIMES[k + 1] - TIMES[k])), 0] for k in range(3)]
    mu = [{"shifts": [-2, 0], "start": h, "end": h} for h in lengths]  # μ = h
    pieces = [
        {**witness(k, 0), "vertex": v, "mode": [mode], "mu": mu[k]}
        for k, v, mode in product(range(3), range(2), (-1, 0, 1))
    ]
    rates: list[dict[str, Any]] = []
    for k, sign in product(range(3), (-1, 1)):
        # u₀ climbs faster than R where it is beyond its limit: 3 (ũ² - 1) h R is added there.
        piece = witness(k, 3 if (k, sign) == (1, 1) else 0)
        still = {"columns": [0, 0], "squares": nothing}
        piece |= {"vertex": 0, "mode": [0], "input": 0, "sign": sign, "tau": [still, *piece["tau"]]}
        rates.append(piece)
    proof = {
        "margin": 0.5,
        "basis": free,
        "multiplier": free,
        "sides": free,
        "pieces": pieces,
        "rates": [[1.0]] * 3,
        "rate_pieces": rates,
    }
    return stated(field, policy, funnel, proof, hold=HOLD)


def integrator(rate: float) -> Files:
    """dx/dt = u, u = -x held for 0.25 s, |x| <= 1 for 2 s: |du/dt| = |x - δ|, |δ| <= 0.25 rate.

    rate: claimed, in 1/s.
    """
    field = {
        "format": "nlsid/vector_field",
        "version": 2,
        "states": 1,
        "inputs": 1,
        "uncertain": [],
        "breaks": [],
        "valid": [],
        "expansion": "",
        "pieces": [[{"exponents": [[0, 0, 1]], "coefficients": [1.0]}]],
    }
    policy = {
        "format": "nlsid/policy",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "t": [0.0, 2.0],
        "x": [[[0.0]]],
        "u": [[[0.0]]],
        "K": [[[[1.0]]]],
        "limits": [],
    }
    funnel = {
        "format": "nlsid/funnel",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "policy": "",
        "t": [0.0, 2.0],
        "x": [[[0.0]]],
        "P": [[[1.0]]] * 2,
        "rho": [1.0] * 2,
    }
    part: dict[str, Any] = {"interval": 0, "level": 0, "index": 0, "columns": [0, 0]}

    def squared(constant: int, unit: int) -> dict[str, Any]:
        """(x + constant / 2^unit)²."""
        return {"unit": unit, "factors": [[[constant, 2**unit]]]}

    # -2x 2(-x + δ) - 2 margin + 2.5 (1 - x²), δ nearly ±11/32
    mu = {"shifts": [-1], "start": [5], "end": [5]}
    pieces = [
        {**part, "vertex": v, "mu": mu, "squares": squared(side * 22, 5)}
        for v, side in ((0, 1), (1, -1))
    ]
    # 2 (R - W) - sign 2x - (1 - x²) = (x - sign)² + 2 (R - W - 1)
    shell = {"columns": [0, 0], "squares": {"unit": 0, "factors": [[[1, 0]]]}}
    rates = [
        {
            **part,
            "vertex": 0,
            "input": 0,
            "sign": sign,
            "tau": [shell],
            "squares": squared(-sign, 0),
        }
        for sign in (-1, 1)
    ]
    proof = {
        "margin": 0.5,
        "basis": [[0], [1]],
        "multiplier": [[0]],
        "sides": [[0], [1]],
        "pieces": pieces,
        "rates": [[rate]],
        "rate_pieces": rates,
    }
    return stated(field, policy, funnel, proof, hold=0.25)
