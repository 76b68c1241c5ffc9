"""The claim `stability` of every class: oracle, sentence, exact counterexamples, forgeries."""

import random
from collections.abc import Callable
from decimal import Context, Decimal
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateRejected
from nlsid_core.identification import prove_stability
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.models import read_model
from tests.core.kernel import oracle_stability as oracle
from tests.core.kernel.refusals import refused
from tests.core.kernel.stability_claims import (
    CONSTANT,
    MODELS,
    claim,
    decide,
    linear,
    state_affine,
)
from tests.core.kernel.stability_forgeries import CHANGES
from tests.marks import slow_among

NAMES = list(MODELS)
NO_INPUT = ("cascade", "network", "monotone", "straight", "linear")  # in the increments of these
MATHEMATICS = ("not_definite", "not_valid")  # a proof is refused though its form is right


def where(name: str, model: Json) -> str:
    """The last part of the sentence, rounded by the decimal module."""
    if name == "cascade":
        low, high = oracle.slopes(model)
        covered = f"[{rounded(low, 'ROUND_FLOOR')}, {rounded(high, 'ROUND_CEILING')}]"
        return f"for every input (the slopes of its nonlinearity are in {covered} everywhere)"
    if name in ("linear", "monotone", "straight", "network"):
        return "for every input"
    low, high = map(Fraction, model["u_range"][0])
    inner = f"[{rounded(low, 'ROUND_CEILING')}, {rounded(high, 'ROUND_FLOOR')}]"
    return f"for every input (the model clips its inputs: command in {inner} V)"


def rounded(value: Fraction, mode: str) -> str:
    own = Decimal(repr(float(value))).normalize()
    if float(value) == value and len(own.as_tuple().digits) <= 6:
        return f"{own:f}"
    four = Context(prec=4, rounding=mode)
    return f"{four.divide(Decimal(value.numerator), Decimal(value.denominator)).normalize():f}"


@pytest.mark.parametrize("name", NAMES)
def test_the_sentence_is_this_and_the_oracle_agrees(name: str) -> None:
    model, proof = claim(name)
    verdict = decide(model, proof)
    rate = proof["claim"]["rate"]
    shown = rounded(Fraction(rate), "ROUND_CEILING")
    assert verdict.statement == (
        "incremental stability: two solutions with the same input approach each other, in the "
        f"norm of P, by a factor of {shown} or less a sample of {model['period']} s, "
        + where(name, model)
    )
    assert verdict.assumptions == ()
    assert verdict.margin == 1 - Fraction(rate)
    assert oracle.is_proved(model, proof["claim"], proof["proof"])


@pytest.mark.parametrize("name", NAMES)
def test_the_kernels_matrices_are_those_of_the_specification(name: str) -> None:
    model, _ = claim(name)
    form = read_model(parse(files.encode(model), "model"))
    F, m, box = oracle.increments(model)
    assert F == form.F
    assert form.E.box == box or form.E.whole == len(form.E.box)  # of slopes: never split
    assert m == form.unknowns
    if m:
        expected = oracle.vertices(model, box)
        assert expected is not None
        found = form.E.vertices(form.E.box)
        # Extreme ones only, where one entry varies: each found is expected, each end is found.
        assert all(E in expected for E in found)
        for i in range(m):
            for j in range(len(F[0])):
                values = [E[i][j] for E in expected]
                kept = [E[i][j] for E in found]
                assert (min(values), max(values)) == (min(kept), max(kept))


@pytest.mark.parametrize("name", [n for n in NAMES if n not in NO_INPUT])
def test_solutions_of_the_model_itself_approach_at_the_stated_rate(name: str) -> None:
    """Exact steps 0 = Σ G_k(w) Δ(t-k) at random inputs of the range, and at its ends."""
    model, proof = claim(name)
    rng, rate = random.Random(1), Fraction(proof["claim"]["rate"])
    P = [[Fraction(entry) for entry in row] for row in proof["proof"]["P"]]
    _, p, box = oracle.increments(model)
    n = len(P)
    for _ in range(100):
        w = [
            low + (high - low) * Fraction(rng.choice((0, 8, rng.randrange(9))), 8)
            for low, high in box
        ]
        E = oracle.value_at(model, w)
        x = [[Fraction(rng.randrange(-9, 10))] for _ in range(n)]
        right = [[-sum((E[a][p + k] * x[k][0] for k in range(n)), Fraction(0))] for a in range(p)]
        after = (oracle.solved([row[:p] for row in E], right) + x)[:n]
        assert _V(P, after) <= rate**2 * _V(P, x)


def _V(P: oracle.Rows, x: oracle.Rows) -> Fraction:
    n = range(len(P))
    return sum((P[i][j] * x[i][0] * x[j][0] for i in n for j in n), Fraction(0))


# -- claims that are false, each with its counterexample -------------------------------------


def test_a_sum_that_floating_point_loses_is_not_lost() -> None:
    """G_0 = w0 - 1e16 + 1e16 … as one term after another cancels to 0.5 at w = 0, not to 1.5."""
    model, proof = claim("quadratic")
    model["G"][0]["exponents"] += [[1, 0], [0, 1]]
    model["G"][0]["coefficients"] += [[[1e16]], [[-1e16]]]
    # At w = (0, 1e-16): G_0 = 1 - 1 + … = 0, where the next output is not determined.
    box = oracle.increments(model)[2]
    w = [Fraction(0), Fraction(1, 10**16)]
    assert all(low <= entry <= high for entry, (low, high) in zip(w, box, strict=True))
    assert abs(oracle.value_at(model, w)[0][0]) < Fraction(1, 10**15)
    with pytest.raises(CertificateRejected):
        decide(model, proof)


def test_a_box_far_away_keeps_every_digit_of_its_ends() -> None:
    """G_0 = (w - 1e9)² - 2, w in [1e9 + 9, 1e9 + 11]: as exact numbers it is at least 79."""
    G_0 = ([[0, 0], [1, 0], [2, 0]], [1e18 - 2.0, -2e9, 1.0])
    model = state_affine(G_0, (CONSTANT, [-40.0]))
    ranges = np.array([[1000000009.0, 1000000011.0]])
    far = model.document() | {"u_range": ranges.tolist(), "u_offset": [0.0], "u_scale": [1.0]}
    form = read_model(parse(files.encode(far), "model"))
    lead = [E[0][0] for E in form.E.vertices(form.E.box)]
    exact = (
        Fraction(9) ** 2 - 2 + (Fraction(1e18 - 2.0) - 10**18 + 2),
        Fraction(11) ** 2 - 2 + (Fraction(1e18 - 2.0) - 10**18 + 2),
    )
    assert (min(lead), max(lead)) == exact


def test_a_rate_of_nearly_one_is_not_printed_as_one() -> None:
    model = linear().document() | {"a": [0.99999, 0.0, 0.0]}
    about = {"model": proofs.binding("model.json", model)}
    P = [[1.0, 0.0, 0.0], [0.0, 1e6, 0.0], [0.0, 0.0, 1e12]]
    rate = 0.999995
    stated = {"kind": "stability", "about": about, "rate": rate}
    proof = proofs.proof_document(stated, {"P": P})
    if not oracle.is_proved(model, stated, proof["proof"]):
        found = prove_stability(type(linear()).from_document(model))
        assert found is not None
        proof = found.document(type(linear()).from_document(model), "model.json")
        rate = found.rate
    said = decide(model, proof).statement.split("by a factor of ")[1].split(" or less")[0]
    assert Fraction(rate) <= Fraction(said) < 1


def test_the_slopes_are_those_of_the_spline() -> None:
    """One larger coefficient makes a slope of 2·10⁶; at it V grows: the claim is false."""
    model, proof = claim("cascade")
    model["f"]["coefficients"][-1] += 1e6
    assert oracle.slopes(model)[1] > 1e6
    F, m, _ = oracle.increments(model)
    _, n1, n2, C, _ = oracle.cascade(model)
    P = [[Fraction(entry) for entry in row] for row in proof["proof"]["P"]]
    s = oracle.slopes(model)[1]
    x = [[Fraction(1)]] + [[Fraction(0)] for _ in range(n1 + n2 - 1)]
    nu = [[s * C[j][0]] for j in range(m)]
    after = [[sum((f * z[0] for f, z in zip(row, nu + x, strict=True)), Fraction(0))] for row in F]
    assert _V(P, after) > _V(P, x)
    with refused("not_definite"):
        decide(model, proof)


# -- smallest false neighbours ---------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_rate_below_the_fastest_is_refused_and_a_slower_one_proved(name: str) -> None:
    for factor, proved in ((1.001, True), (0.9, False)):
        model, proof = claim(name)
        proof["claim"]["rate"] = min(proof["claim"]["rate"] * factor, 1 - 1e-9)
        if proved:
            decide(model, proof)
        else:
            with refused("not_definite"):
                decide(model, proof)


@pytest.mark.parametrize("change", CHANGES)
def test_a_forgery_with_right_digests_is_refused(change: str) -> None:
    name, made, reason = CHANGES[change]
    model, proof = claim(name)
    made(model, proof["proof"])
    if reason in MATHEMATICS:
        assert not oracle.is_proved(model, proof["claim"], proof["proof"])
    with refused(reason):
        decide(model, proof)


def test_an_endless_tree_is_refused() -> None:
    model, proof = claim("split")
    tree: Json = {"N": [[1.0], [0.0]]}
    for _ in range(60):
        tree = {"split": 0, "parts": [tree, {"N": [[1.0], [0.0]]}]}
    proof["proof"]["multipliers"] = tree
    with pytest.raises(CertificateRejected):
        decide(model, proof)


ODD: list[tuple[str, Callable[[Json, Json], Any], str]] = [
    ("quadratic", lambda m, _: m["G"][0]["exponents"].__setitem__(1, [0, 0]), "malformed"),
    ("linear", lambda m, _: m.update(equation=["y", "u"]), "malformed"),
    ("linear", lambda _, d: d["proof"]["P"][0].__setitem__(0, 2**53 + 1), "malformed"),
    ("monotone", lambda m, _: m.update(e=[3.0, 3.0, 1.0]), "not_definite"),  # e' = 0 at v = -1
    ("monotone", lambda m, _: m.update(e=[1.0, 0.1, 0.0]), "not_valid"),
    ("monotone", lambda m, _: m.update(e=[3.0, 0.0, -1.0]), "not_valid"),
    *(
        ("linear", lambda _, d, rate=rate: d["claim"].update(rate=rate), "not_below")
        for rate in (1.0, 1.5, 0.0, -0.9)
    ),
    *(
        ("linear", lambda _, d, rate=rate: d["claim"].update(rate=rate), "malformed")
        for rate in ("1", None, True, [1.0], {"a": 1})
    ),
]


@pytest.mark.parametrize(("name", "change", "reason"), ODD)
def test_what_is_out_of_range_is_refused_with_the_reason(
    name: str, change: Callable[[Json, Json], Any], reason: str
) -> None:
    model, proof = claim(name)
    change(model, proof)
    with refused(reason):
        decide(model, proof)


@pytest.mark.parametrize("name", slow_among(NAMES, {"network", "split"}))
def test_a_proof_that_is_written_by_the_prover_is_the_same_every_time(name: str) -> None:
    model = MODELS[name]()
    first, second = (prove_stability(model) for _ in range(2))
    assert first is not None
    assert second is not None
    assert first.document(model, "m.json") == second.document(model, "m.json")


def test_what_is_not_stable_is_not_proved() -> None:
    unstable = state_affine((CONSTANT, [1.0]), (CONSTANT, [-1.01]))
    assert prove_stability(unstable) is None
    for_some = state_affine(([[0, 0], [1, 0]], [1.0, 0.3]), (CONSTANT, [-0.8]))
    assert prove_stability(for_some) is None  # G_0 = 0.53 at the lower end
