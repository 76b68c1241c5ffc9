"""The kernel's continuous funnels against an oracle in Fractions, and false claims from scratch."""

import os
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import proofs
from nlsid_core.design import (
    ContinuousTracking,
    FunnelDesign,
    Goal,
    design_funnel,
    integrate_nominal,
)
from nlsid_core.dynamics import VectorField
from nlsid_core.kernel import closed_loop
from nlsid_core.kernel.exact import inverse_forms
from nlsid_core.kernel.polynomials import Polynomial, Ring
from tests.core.kernel import refusals
from tests.core.kernel.oracle_continuous import Oracle
from tests.edits import Edit, both, changed, put, scaled, without
from tests.funnel_files import (
    FIELD,
    FUNNEL,
    POLICY,
    PROOF,
    Files,
    bind,
    copy_of,
    files_of,
    stated,
    write,
)
from tests.marks import slow_among

NUMBERS: list[Callable[[np.random.Generator], float]] = [
    lambda rng: float(rng.integers(-16, 17)) / 8,
    lambda rng: float(rng.normal()),
    lambda rng: 1e9 + float(rng.integers(-3, 4)),
    lambda rng: float(rng.normal()) * 1e-9,
]


def number(rng: np.random.Generator) -> float:
    """A float64 of one of several sizes."""
    return NUMBERS[int(rng.choice(4, p=[0.6, 0.3, 0.05, 0.05]))](rng)


def coefficient(rng: np.random.Generator) -> float | str:
    """A float64, or a rational whose denominator may be odd and beyond 2^63."""
    if rng.uniform() < 0.7:
        return number(rng)
    return f"{int(rng.integers(-99, 100))}/{3 ** int(rng.integers(1, 45)) * 2}"


def nested(rng: np.random.Generator, *shape: int) -> Any:
    """Random numbers of a shape."""
    return [nested(rng, *shape[1:]) for _ in range(shape[0])] if shape else number(rng)


def random_claim(rng: np.random.Generator) -> Files:
    """Documents of every feature at random; the witness is not one."""
    n, m, n_w = int(rng.integers(1, 4)), int(rng.integers(0, 3)), int(rng.integers(0, 3))
    intervals = int(rng.integers(1, 3))
    t = np.cumsum(rng.integers(1, 9, intervals + 1)).astype(float) / 8
    breaks = t[1:-1][rng.uniform(size=intervals - 1) < 0.5].tolist()
    pushed = n_w > 0 and rng.uniform() < 0.5
    spans = []
    for _ in range(len(breaks) + 1):
        equations = []
        for i in range(n):
            rows = {tuple(rng.integers(0, 2, 1 + n + m).tolist()) for _ in range(4)}
            rows |= {(int(rng.integers(0, 2)), *rng.integers(0, 3, n + m).tolist())}
            rows = {row for row in rows if sum(row) <= 5}
            whole = [
                [*row, *([0] * n_w if pushed else rng.integers(0, 2, n_w).tolist())] for row in rows
            ]
            if pushed:
                whole.append([*[0] * (1 + n + m), *[int(j == i % n_w) for j in range(n_w)]])
            whole.sort()
            equations.append(
                {"exponents": whole, "coefficients": [coefficient(rng) for _ in whole]}
            )
        spans.append(equations)
    limited = int(rng.integers(0, m + 1)) if rng.uniform() < 0.7 else 0
    box = [sorted([number(rng), number(rng)]) for _ in range(n_w)]
    x = nested(rng, intervals, int(rng.integers(2, 5)), n)
    for before, after in pairwise(x):
        after[0] = before[-1]
    roots = rng.integers(-8, 9, (intervals + 1, n, n)) / 8
    P = roots @ roots.transpose(0, 2, 1) + np.eye(n)
    field = {
        "format": "nlsid/vector_field",
        "version": 2,
        "states": n,
        "inputs": m,
        "uncertain": box,
        "breaks": breaks,
        "valid": [],
        "expansion": "",
        "pieces": spans,
    }
    policy = {
        "format": "nlsid/policy",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "t": t.tolist(),
        "x": x,
        "u": nested(rng, intervals, int(rng.integers(1, 5)), m),
        "K": nested(rng, intervals, int(rng.integers(1, 5)), m, n),
        "limits": [[i, -1.0, float(rng.integers(0, 9))] for i in range(limited)],
    }
    funnel = {
        "format": "nlsid/funnel",
        "version": 2,
        "kind": "continuous",
        "vector_field": "",
        "policy": "",
        "t": t.tolist(),
        "x": x,
        "P": P.tolist(),
        "rho": rng.uniform(0.5, 2, intervals + 1).tolist(),
    }
    first = [[0] * n, *np.eye(n, dtype=int).tolist()]
    proof: dict[str, Any] = {
        "margin": abs(number(rng)) + 0.1,
        "basis": first,
        "multiplier": [*first, [2, *[0] * (n - 1)]],
        "pieces": [],
    }
    if limited:
        proof["sides"] = first
    if pushed:
        proof["kappa"] = rng.uniform(0.5, 2, (intervals, n_w)).tolist()
    modes = list(product((-1, 0, 1), repeat=limited))
    claimed = random_hold(rng, files=(field, policy), proof=proof)
    moved = bool(claimed)
    held = 2**m if moved else 1
    vertices = held if pushed else held * 2**n_w
    for k, mode, vertex in product(range(intervals), modes, range(vertices)):
        level = int(rng.integers(0, 2))
        for index in range(2**level):
            proof["pieces"].append(random_piece(rng, proof, k, vertex, (level, index), mode))
    if "hold" in claimed:
        proof["rates"] = rng.uniform(0.5, 2, (intervals, m)).tolist()
        proof["rate_pieces"] = []
        counts = Oracle(field, policy, funnel, proof, claimed).rate_vertices()
        for k, mode, v, i, sign in product(
            range(intervals), modes, range(counts), range(m), (-1, 1)
        ):
            if i >= limited or not mode[i]:
                rated = proof | {"multiplier": []}
                piece = random_piece(rng, rated, k, v, (0, 0), (0, *mode))
                del piece["mu"]
                piece |= {"input": i, "sign": sign, "mode": list(mode)}
                if not mode:
                    del piece["mode"]
                proof["rate_pieces"].append(piece)
    return stated(field, policy, funnel, proof, **claimed)


def random_hold(rng: np.random.Generator, *, files: tuple[Any, Any], proof: Any) -> Any:
    """A hold, a measurement error, both or none; then f is affine in u, and u and K continuous."""
    (field, policy), claimed = files, {}
    if files[0]["inputs"] and rng.uniform() < 0.5:
        claimed["hold"] = float(rng.uniform(0.01, 2))
        for name in ("u", "K"):
            for before, after in pairwise(policy[name]):
                after[0] = before[-1]
        proof["sides"] = proof["basis"]
    if rng.uniform() < 0.5:
        claimed["error"] = rng.uniform(0, 1, field["states"]).tolist()
    if claimed:
        n, m = field["states"], field["inputs"]
        for equation in (e for span in field["pieces"] for e in span):
            rows = {}
            for row, c in zip(equation["exponents"], equation["coefficients"], strict=True):
                single = [
                    *row[: 1 + n],
                    *(min(e, 1) for e in row[1 + n : 1 + n + m]),
                    *row[1 + n + m :],
                ]
                rows[tuple(single)] = c
            equation["exponents"] = [list(row) for row in sorted(rows)]
            equation["coefficients"] = [rows[row] for row in sorted(rows)]
    return claimed


def random_piece(
    rng: np.random.Generator,
    proof: Any,
    k: int,
    vertex: int,
    half: tuple[int, int],
    mode: tuple[int, ...],
) -> Any:
    """A piece with random multipliers; half: the level and index of its part of time."""
    size, count = len(proof["basis"]), len(proof.get("multiplier", []))
    shell = 0 if "multiplier" in proof else 2
    mu = {
        "shifts": rng.integers(-9, 3, count),
        "start": rng.integers(-99, 100, count),
        "end": rng.integers(-99, 100, count),
    }
    squares = [
        {
            "columns": rng.integers(-3, 4, size).tolist(),
            "squares": {
                "unit": int(rng.integers(0, 9)),
                "factors": rng.integers(-9, 10, (j + 1, 2, size)).tolist(),
            },
        }
        for j in range(1 + shell + len(mode))
    ]
    piece = {
        "interval": k,
        "vertex": vertex,
        "level": half[0],
        "index": half[1],
        "mu": {key: row.tolist() for key, row in mu.items()},
        **squares[0],
    }
    if shell:
        del piece["mu"]
    piece |= {"mode": list(mode)} if mode else {}
    return piece | ({"tau": squares[1:]} if mode or shell else {})


def value(c: Polynomial, ring: Ring, s: Fraction, x: list[Fraction]) -> Fraction:
    """The kernel's polynomial at a point, from its own coefficients."""
    total = Fraction(0)
    for key, coefficients in ring.coefficients(c):
        monomial = Fraction(1)
        for i, e in enumerate(x):
            monomial *= e ** ((key >> (6 * i)) & 63)
        total += sum(entry * s**k for k, entry in enumerate(coefficients)) * monomial
    return total / c.denominator


def fraction(rng: np.random.Generator, size: int = 3) -> Fraction:
    """A random rational."""
    return Fraction(int(rng.integers(-99 * size, 99 * size)), int(rng.integers(1, 99)))


@pytest.mark.parametrize("seed", slow_among(range(80), range(8, 80)))
def test_the_kernel_rebuilds_exactly_what_the_page_says(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    files = random_claim(rng)
    proof = files[PROOF]["proof"]
    seen: list[tuple[Polynomial, Ring]] = []

    def record(c: Polynomial, _squares: Any, ring: Ring, _what: str) -> None:
        list(ring.coefficients(c))  # a ring that is too narrow is tried again wider
        seen.append((c, ring))

    monkeypatch.setattr(closed_loop, "positive", record)
    assert proofs.decide(files[PROOF], files).margin == Fraction(proof["margin"])
    oracle = Oracle(files[FIELD], files[POLICY], files[FUNNEL], proof, files[PROOF]["claim"])
    rates = product([oracle.rate_left], proof.get("rate_pieces", []))
    for (c, ring), (claimed, piece) in zip(
        seen, [*product([oracle.c], proof["pieces"]), *rates], strict=True
    ):
        for _ in range(2):
            at = Fraction(int(rng.integers(0, 100)), 99), [fraction(rng) for _ in range(oracle.n)]
            assert value(c, ring, *at) == claimed(piece, *at)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_reach_of_an_ellipsoid_is_exact(n: int) -> None:
    """M q = g solved by Gauss-Jordan in Fractions; g'q is g'M⁻¹g."""
    rng = np.random.default_rng(n)
    A = [[fraction(rng) for _ in range(n)] for _ in range(n)]
    M = [
        [sum((r[i] * r[j] for r in A), Fraction(int(i == j), 5)) for j in range(n)]
        for i in range(n)
    ]
    vectors = [[fraction(rng) for _ in range(n)] for _ in range(3)]
    for g, found in zip(vectors, inverse_forms(M, vectors, "M"), strict=True):
        rows = [[*row, e] for row, e in zip(M, g, strict=True)]
        for k in range(n):
            rows[k] = [a / rows[k][k] for a in rows[k]]
            for i in set(range(n)) - {k}:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
        assert found == sum((a * row[n] for a, row in zip(g, rows, strict=True)), Fraction(0))
    M[0][0] = Fraction(0)
    with refusals.refused("not_definite"):
        inverse_forms(M, vectors, "M")


# -- decided consistently ------------------------------------------------------------------------


def cubic(x: Any, u: Any, w: Any) -> Any:
    """ẋ = x - x³/3 + u + w/8."""
    return np.array([x[0] - x[0] ** 3 / 3 + u[0] + w[0] / 8])


PART = f"{PROOF} proof"


@pytest.fixture(scope="module")
def design() -> FunnelDesign:
    """One state, a clipped input, a disturbance, a bound on x, a goal around another point."""
    field = VectorField.from_function(
        cubic, 1, 1, uncertain=[[-0.125, 0.25]], valid=[[0, -4.0, 4.0]], expansion="by hand"
    )
    nominal = integrate_nominal(field, lambda _: [0.0], t=np.linspace(0, 0.5, 5), start=[0.0])
    goal = Goal(np.array([0.0625]), np.array([[1.0]]))
    return design_funnel(ContinuousTracking(field, nominal, goal=goal, limits=[[0, -1.5, 2.0]]))


@pytest.fixture
def files(design: FunnelDesign) -> Files:
    """Its documents."""
    return files_of(design)


def test_the_sentence_says_what_is_decided_and_nothing_more(files: Files, tmp_path: Path) -> None:
    verdict = proofs.check(write(files, tmp_path))
    assert verdict.margin == Fraction(files[PROOF]["proof"]["margin"])
    count = len(files[PROOF]["proof"]["pieces"])
    assert verdict.statement == (
        "funnel: every solution that is in it at a time from 0 to 0.5 s, such as x = (0) "
        "at 0 s, stays in it until 0.5 s, ends in the goal, an ellipsoid within x0 in "
        "[-0.9375, 1.0625], and keeps x0 in [-4, 4]; "
        f"{count} pieces of time decided, on its boundary V falls by at least the margin, in 1/s"
    )
    assert verdict.assumptions == (
        "the state obeys the stored equations and the stored policy is applied continuously, "
        "with no hold and no delay, u0 clipped to [-1.5, 2]",
        "at every time w0 in [-0.125, 0.25]",
        "the equations expand others, and that the ranges of w cover what they leave out is an "
        'assumption of the vector field, computed by: "by hand"',
    )
    assert Fraction(str(verdict).split("\n")[0].rsplit(" ", 1)[1]) <= verdict.margin


# -- each class of fault as a false claim ----------------------------------------------------------


def worst(files: Files) -> Fraction:
    """The least dρ/ds - dW/ds - margin hρ on the boundary, over pieces whose mode holds there."""
    proof = copy_of(files)[PROOF]["proof"]
    for piece in proof["pieces"]:
        piece["mu"] = {key: [0] * len(row) for key, row in piece["mu"].items()}
        for tau in piece["tau"]:
            tau["squares"]["factors"] = [[]]
    oracle = Oracle(files[FIELD], files[POLICY], files[FUNNEL], proof)
    low, high = (Fraction(e) for e in files[POLICY]["limits"][0][1:])
    found = []
    for piece in proof["pieces"]:
        k = piece["interval"]
        for s, knot in ((Fraction(0), k), (Fraction(1), k + 1)):
            square = Fraction(files[FUNNEL]["rho"][knot]) / Fraction(files[FUNNEL]["P"][knot][0][0])
            root = Fraction(float(square) ** 0.5)  # nearly on the boundary
            for x in (root, -root):
                points = files[POLICY]["K"][k]
                wanted = -Fraction(points[0 if s == 0 else -1][0][0]) * x
                mode = -1 if wanted < low else 1 if wanted > high else 0
                if piece["mode"] == [mode] and s in (0, 1) and not piece["level"]:
                    found.append(oracle.c(piece, s, [x]))
    return min(found)


def test_the_oracle_finds_no_fault_in_what_is_true(files: Files) -> None:
    assert worst(files) > 0


def test_repeated_monomials_are_refused_not_added_up(files: Files) -> None:
    """In floats -1e16 - 1 + 1e16 - 0.5 is -0.5, exactly it is -1.5."""
    equation = files[FIELD]["pieces"][0][0]
    place = equation["exponents"].index([0, 1, 0, 0])
    for extra in (1e16, 1.5, -1e16):
        equation["exponents"].insert(place, [0, 1, 0, 0])
        equation["coefficients"].insert(place, extra)
    refusals.refused_with_fresh_digests(files, "malformed")


def test_an_odd_denominator_beyond_64_bits_is_what_it_is(files: Files) -> None:
    """3^41 > 2^63. The same rate written over it is proved; one that pushes out is not."""
    equation = files[FIELD]["pieces"][0][0]
    place = equation["exponents"].index([0, 1, 0, 0])
    equation["coefficients"][place] = f"{3**41}/{3**41}"
    bind(files)
    assert proofs.decide(files[PROOF], files).margin > 0
    equation["coefficients"][place] = f"{9 * 3**41 + 1}/{3**41}"
    assert worst(files) < 0
    refusals.refused_with_fresh_digests(files, "not_positive")


@pytest.mark.parametrize(
    "place",
    [
        f"{PROOF} claim goal centre 0",
        f"{PROOF} claim goal P 0 0",
        f"{POLICY} limits 0 2",
        f"{FIELD} valid 0 2",
        f"{FIELD} uncertain 0 1",
        f"{FIELD} pieces 0 0 coefficients 0",
        f"{PROOF} proof margin",
        f"{FUNNEL} rho 0",
    ],
)
def test_whole_numbers_beyond_2_to_the_53_are_refused(files: Files, place: str) -> None:
    put(place, 2**53 + 1)(files)
    refusals.refused_with_fresh_digests(files, "malformed")


def test_a_box_far_away_and_narrow_is_taken_exactly(files: Files) -> None:
    """w in [1e9 + 9, 1e9 + 11] with a constant that takes 1e9 + 10 off again: w - 1e9 - 10 is 1."""
    equation = files[FIELD]["pieces"][0][0]
    files[FIELD]["uncertain"] = [[1000000009.0, 1000000011.0]]
    equation["exponents"].insert(0, [0, 0, 0, 0])
    equation["coefficients"].insert(0, -1000000010 / 8)
    assert worst(files) < 0  # the funnel was made for a w of at most 0.25
    refusals.refused_with_fresh_digests(files, "not_positive")


def test_limits_that_clip_out_of_where_the_dynamics_are_valid_are_refused(files: Files) -> None:
    """ũ is within [-9, 1.5] in the funnel; clipped to [2, 3] the input is 2, outside."""
    files[FIELD]["valid"] = [[1, -9.0, 1.5]]
    files[POLICY]["limits"] = [[0, 2.0, 3.0]]
    refusals.refused_with_fresh_digests(files, "not_valid")


def test_a_clipped_input_may_leave_valid_on_the_side_its_limit_does_not_keep(files: Files) -> None:
    """Its lower limit -1.5 keeps [-1.5, ...]; above, the limit 2 does not keep u <= 1."""
    files[FIELD]["valid"] = [[1, -1.5, 2.0]]
    bind(files)
    assert "keeps u0 in [-1.5, 2]" in proofs.decide(files[PROOF], files).statement
    files[FIELD]["valid"] = [[1, -1.5, 1.0]]
    x = -((files[FUNNEL]["rho"][0] / files[FUNNEL]["P"][0][0][0]) ** 0.5)
    assert -files[POLICY]["K"][0][0][0][0] * x > 1  # what the policy asks for there
    refusals.refused_with_fresh_digests(files, "not_valid")


NO_MULTIPLIER = without(f"{PART} goal_multiplier")
HOSTILE: dict[str, tuple[Edit, str]] = {
    "level -1": (put(f"{PART} pieces 0 level", -1), "malformed"),
    "level 17": (put(f"{PART} pieces 0 level", 17), "malformed"),
    "index": (put(f"{PART} pieces 0 index", 2), "malformed"),
    "interval": (put(f"{PART} pieces 0 interval", 99), "not_covered"),
    "vertex": (put(f"{PART} pieces 0 vertex", 2), "not_covered"),
    "true for one": (put(f"{PART} pieces 0 vertex", True), "malformed"),
    "column 5000": (put(f"{PART} pieces 0 columns 0", 5000), "malformed"),
    "shift 5000": (put(f"{PART} pieces 0 mu shifts 0", 5000), "malformed"),
    "shift -5000": (put(f"{PART} pieces 0 mu shifts 0", -5000), "malformed"),
    "unit 5000": (put(f"{PART} pieces 0 squares unit", 5000), "malformed"),
    "no factors": (put(f"{PART} pieces 0 squares factors", []), "malformed"),
    "no pieces": (put(f"{PART} pieces", []), "malformed"),
    "margin 0": (put(f"{PART} margin", 0), "not_below"),
    "margin -0.0": (put(f"{PART} margin", -0.0), "not_below"),
    "goal": (put(f"{PART} goal_multiplier", -1.0), "not_below"),
    "basis without 1": (put(f"{PART} basis", [[1], [2], [3]]), "not_positive"),
    "monomials twice": (put(f"{PART} multiplier 0", [1]), "malformed"),
    "unknown": (put(f"{PART} note", "all is well"), "malformed"),
    "kappa without pushes": (put(f"{PART} kappa", [[1.0]] * 4), "not_covered"),
    "exponent 5000": (put(f"{FIELD} pieces 0 0 exponents -1 1", 5000), "malformed"),
    "exponent -1": (put(f"{FIELD} pieces 0 0 exponents -1 1", -1), "malformed"),
    "too wide at the last knot only": (
        both(scaled(f"{FUNNEL} rho -1", 1e3), without(f"{PROOF} claim goal"), NO_MULTIPLIER),
        "not_valid",
    ),
    "no goal": (without(f"{PROOF} claim goal"), "malformed"),
    "two lines": (put(f"{FIELD} expansion", "by hand\nPROVED everything"), "malformed"),
    "a nominal that jumps": (
        both(put(f"{POLICY} x 2 0 0", 0.5), put(f"{FUNNEL} x 2 0 0", 0.5)),
        "malformed",
    ),
    "a break between knots": (
        both(put(f"{FIELD} breaks", [0.3]), changed(f"{FIELD} pieces", lambda spans: 2 * spans)),
        "malformed",
    ),
}


@pytest.mark.parametrize(("change", "reason"), HOSTILE.values(), ids=HOSTILE)
def test_what_is_out_of_range_is_refused_with_the_reason(
    files: Files, change: Edit, reason: str
) -> None:
    change(files)
    refusals.refused_with_fresh_digests(files, reason)


def test_a_claim_without_its_goal_says_nothing_of_it(files: Files) -> None:
    both(without(f"{PROOF} claim goal"), NO_MULTIPLIER)(files)
    assert "goal" not in proofs.decide(files[PROOF], files).statement


def test_a_name_of_a_file_with_a_second_line_prints_none(files: Files) -> None:
    files[PROOF]["claim"]["about"]["funnel"]["file"] = "funnel.json\nPROVED"
    with refusals.refused("malformed"):
        proofs.decide(files[PROOF], files)


def test_a_pipe_in_the_place_of_a_file_is_refused_at_once(files: Files, tmp_path: Path) -> None:
    path = write(files, tmp_path)
    (tmp_path / FUNNEL).unlink()
    os.mkfifo(tmp_path / FUNNEL)
    with refusals.refused("mismatch"):
        proofs.check(path)
