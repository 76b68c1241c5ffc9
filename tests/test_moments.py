"""Moments of repeated experiments, and the robust identification error through them."""

import json
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import check, proof_document
from nlsid_core.certificate.monotone_equation import dissipation
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, ShapeError
from nlsid_core.identification.from_repeats import identify_from_repeats
from nlsid_core.identification.moment_inequalities import Layout
from nlsid_core.identification.moment_rie import MomentFit, minimise_moment_rie, moment_bound
from nlsid_core.identification.moments import (
    Moments,
    MonotoneClass,
    Offsets,
    offsets_of,
    plain_moments,
    repeated_moments,
)
from nlsid_core.identification.monotone_comparators import (
    least_squares_equation,
    minimise_monotone_simulation_error,
    simulate_banded,
)
from nlsid_core.identification.repeats import compare_repeats
from nlsid_core.models import MonotoneEquation, Signal
from nlsid_core.models.monotone_equation import is_increasing, solve_increasing
from nlsid_core.polynomial import Gram, Polynomial, constant, variables
from nlsid_core.trajectory import Dataset, Trajectory

NOISE = 0.05
CLASS = MonotoneClass(2, (0,))
OFFSETS = Offsets(0.0, np.zeros(1))


def truth() -> MonotoneEquation:
    return MonotoneEquation(
        e=np.array([3.0, 0.6, 1.0]),
        a=np.array([1.2, -0.5]),
        b=np.array([1.0]),
        c=0.1,
        window=((0, 0),),
        y_offset=0.0,
        u_offset=np.zeros(1),
        period=0.01,
        y=Signal("y", "m"),
        u=(Signal("u", "V"),),
    )


def run(w: FloatArray, noise: float, seed: int, group: str = "pair") -> Trajectory:
    y = truth().simulate(w) + noise * np.random.default_rng(seed).standard_normal(len(w))
    t = 0.01 * np.arange(len(w))
    return Trajectory(t=t, y=y, u=w, name=f"run {seed}", group=group)


def pair(samples: int, seed: int, noise: float = NOISE) -> tuple[Trajectory, Trajectory]:
    w = np.random.default_rng(seed).uniform(-2.0, 2.0, samples)
    return run(w, noise, 1000 + seed, f"g{seed}"), run(w, noise, 2000 + seed, f"g{seed}")


def percent(model: MonotoneEquation, *, seed: int = 99) -> float:
    w = np.random.default_rng(seed).uniform(-2.0, 2.0, 3000)
    y = truth().simulate(w)
    return float(100 * np.linalg.norm(model.simulate(w) - y) / np.linalg.norm(y - y.mean()))


@pytest.fixture(scope="module")
def fit() -> MomentFit:
    return identify_from_repeats(Dataset(pair(4000, 1)), CLASS)


@pytest.fixture(scope="module")
def documents(fit: MomentFit) -> tuple[Json, Json]:
    return fit.model.document(), fit.proof.document(fit.model, "model.json")


# -- the model -------------------------------------------------------------------------------


@pytest.mark.parametrize("e", [(1.0, 0.0, 0.0), (3.0, 1.0, 1.0), (0.1, 0.0, 5.0), (1.0, -1.7, 1.0)])
def test_an_increasing_cubic_is_inverted_from_any_guess(e: tuple[float, float, float]) -> None:
    for v in (-1e4, -3.0, -1e-9, 0.0, 0.2, 7.0, 1e5):
        target = ((e[2] * v + e[1]) * v + e[0]) * v
        for guess in (0.0, -50.0, 1e3, v):
            found = solve_increasing(e, target, guess)
            slope = (3 * e[2] * v + 2 * e[1]) * v + e[0]
            sizes = abs(e[2] * v**3) + abs(e[1] * v**2) + abs(e[0] * v)
            assert abs(found - v) <= 1e-13 * (abs(v) + sizes / slope) + 1e-300


def test_a_function_that_is_not_increasing_is_refused() -> None:
    assert is_increasing(np.array([1.0, 1.7, 1.0]))
    assert not is_increasing(np.array([1.0, 1.75, 1.0]))
    assert not is_increasing(np.array([3.0, 3.0, 1.0])), "the slope vanishes at -1"
    for e in ([0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.0, 0.0, -1.0]):
        with pytest.raises(DataError, match="increasing"):
            replace(truth(), e=np.array(e))


def test_simulation_solves_the_equation_and_documents_round_trip() -> None:
    model = replace(truth(), y_offset=0.3, u_offset=np.array([0.1]), window=((0, 0), (0, 3)),
                    b=np.array([1.0, -0.4]))  # fmt: skip
    u = np.random.default_rng(0).standard_normal(200)
    y = model.simulate(u, np.array([0.2, -0.1, 0.4])) - 0.3
    left = ((1.0 * y + 0.6) * y + 3.0) * y
    right = 0.1 + 1.2 * y[2:-1] - 0.5 * y[1:-2] + (u[3:] - 0.1) - 0.4 * (u[:-3] - 0.1)
    np.testing.assert_allclose(left[3:], right, atol=1e-13)
    again = MonotoneEquation.from_document(json.loads(json.dumps(model.document())))
    assert again.document() == model.document()
    np.testing.assert_array_equal(again.simulate(u), model.simulate(u))


def test_the_banded_simulation_is_the_models_own() -> None:
    trial = run(np.random.default_rng(3).uniform(-2, 2, 500), NOISE, 3)
    own = truth().simulate(trial.u, trial.y[:2, 0])
    banded = simulate_banded(truth(), trial)
    assert banded is not None
    assert np.abs(banded - own).max() < 1e-11


# -- moments ---------------------------------------------------------------------------------


def test_moments_without_noise_are_the_averages_of_the_monomials() -> None:
    first, second = pair(400, 5, noise=0.0)
    M = repeated_moments([[first, second]], CLASS, OFFSETS).matrix()
    y, u = first.y[:, 0], first.u[:, 0]
    now = y[2:]
    rows = [now, now**2, now**3, np.ones_like(now), y[1:-1], y[:-2], u[2:]]
    Lambda = np.stack(rows)
    np.testing.assert_allclose(M, Lambda @ Lambda.T / len(now), atol=1e-12)
    plain = plain_moments([first], CLASS, OFFSETS)
    np.testing.assert_allclose(plain.matrix(), M, atol=1e-12)
    np.testing.assert_allclose(plain.noise()[1:], 0.0, atol=1e-12)


def test_the_bias_of_noise_is_removed_from_every_moment() -> None:
    noisy, clean = pair(30_000, 6, noise=0.3), pair(30_000, 6, noise=0.0)
    exact = plain_moments([clean[0]], CLASS, OFFSETS).matrix()
    unbiased = repeated_moments([noisy], CLASS, OFFSETS)
    biased = plain_moments(noisy, CLASS, OFFSETS).matrix()
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    assert np.abs((unbiased.matrix() - exact) / scale).max() < 0.03
    assert np.abs((biased - exact) / scale).max() > 0.3
    assert unbiased.noise()[2] == pytest.approx(0.09, rel=0.03)
    assert unbiased.noise()[4] == pytest.approx(3 * 0.09**2, rel=0.2)


def test_both_roles_count_the_same() -> None:
    first, second = pair(300, 7)
    one = repeated_moments([[first, second]], CLASS, OFFSETS).matrix()
    other = repeated_moments([[second, first]], CLASS, OFFSETS).matrix()
    np.testing.assert_allclose(one, other, atol=1e-12)


def test_moments_add_over_bags_and_over_an_executor() -> None:
    groups = [pair(300, seed) for seed in (1, 2, 3)]
    together = repeated_moments(groups, CLASS, OFFSETS)
    apart = [repeated_moments([group], CLASS, OFFSETS) for group in groups]
    summed = apart[0] + apart[1] + apart[2]
    with ThreadPoolExecutor(2) as executor:
        spread = repeated_moments(groups, CLASS, OFFSETS, executor=executor)
    for other in (summed, spread):
        assert other.count == together.count
        np.testing.assert_allclose(other.matrix(), together.matrix(), atol=1e-12)


def test_three_repeats_use_every_pair() -> None:
    w = np.random.default_rng(0).uniform(-1, 1, 200)
    runs = [run(w, NOISE, seed) for seed in range(3)]
    assert repeated_moments([runs], CLASS, OFFSETS).count == 6 * 198


# -- the inequalities ------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("n", [1, 3])
def test_the_gram_matrices_are_the_inequalities_of_the_thesis(n: int, degree: int) -> None:
    """(3.8) and (3.9), multiplied out from their definitions with random unknowns."""
    rng = np.random.default_rng(n + degree)
    layout = Layout(n, 1, degree)
    unknowns = rng.integers(-5, 6, layout.unknowns).astype(float)
    P, c, R = unknowns[layout.P], unknowns[layout.c], unknowns[layout.R]
    x, other = ([*variables([f"{letter}{k}" for k in range(n)])] for letter in "xz")
    y, v, w = variables("y v w")
    one = 0 * y + 1

    def e(s: Polynomial) -> Polynomial:
        return total(c[k] * s ** (k + 1) for k in range(degree))

    def f(state: list[Polynomial]) -> Polynomial:
        past = total(-k * s for k, s in zip(c[degree + 1 :], state, strict=False))
        return total([past, -c[degree] * one, -c[-1] * w])

    def storage(delta: list[Polynomial]) -> Polynomial:
        return form(P, delta)

    delta = [a - b for a, b in zip(x, other, strict=True)]
    d = v - y
    moved = [d, *delta[:-1]]
    slack = total(s * s for s in delta)
    p = 2 * d * (e(v) - e(y) - f(x) + f(other)) + storage(delta) - storage(moved) - 0.25 * slack
    cubic = degree == 3
    z8 = [*delta, d, (v + y) * d] if cubic else [*delta, d]
    rest = 0.5 * c[2] * d**4 if cubic else 0 * y
    assert_same(p, form(layout.stability(0.25).at(unknowns), z8) + rest)
    # Here the measured point is (other, y), the model's is (x, v).
    Lambda = [*([y, y**2, y**3] if cubic else [y]), one, *other, w]
    q = form(R, Lambda) - delta[0] ** 2 + storage(delta) - storage(moved) + 2 * d * (e(v) - f(x))
    z9 = [*Lambda, *delta, d, *([y * d, d**2] if cubic else [])]
    assert_same(q, form(layout.error_bound().at(unknowns), z9))


def form(Q: FloatArray, z: list[Polynomial]) -> Polynomial:
    k = range(len(z))
    return total(float(Q[i, j]) * z[i] * z[j] for i in k for j in k)


def total(parts: Iterable[Polynomial]) -> Polynomial:
    result = constant(0.0)
    for part in parts:
        result = result + part
    return result


def assert_same(p: Polynomial, q: Polynomial) -> None:
    difference = (p - q).coefficients
    assert np.abs(difference).max(initial=0.0) < 1e-9


def test_sizes_are_those_of_the_structure() -> None:
    layout = Layout(22, 1, 3)
    assert (layout.stability(1e-3).order, layout.error_bound().order) == (24, 52)
    assert layout.unknowns == 664


def test_the_claims_matrix_is_a_sum_of_squares_proof_of_the_inequality() -> None:
    """The checker's G against the polynomial of Lemma 2.10, multiplied out exactly."""
    model, rate = truth(), Fraction(3, 4)
    P = [[Fraction(2), Fraction(1, 3)], [Fraction(1, 3), Fraction(1)]]
    G = dissipation(model, P, rate)
    D0, D1, d, s = (v.exact() for v in variables("D0 D1 d s"))
    e1, e2, e3 = (Fraction(float(k)) for k in model.e)
    a = [Fraction(float(k)) for k in model.a]
    # e(v) - e(v') for d = v - v', s = v + v'.
    difference = d * (e1 + e2 * s + e3 * (3 * s**2 + d**2) * Fraction(1, 4))

    def V(p: Polynomial, q: Polynomial) -> Polynomial:
        return total([P[0][0] * p * p, 2 * P[0][1] * p * q, P[1][1] * q * q])

    left = 2 * d * (difference - a[0] * D0 - a[1] * D1) + rate**2 * V(D0, D1) - V(d, D0)
    basis = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])
    gram = Gram(basis, np.array(G, dtype=object), ("D0", "D1", "d", "s"))
    rest = left - gram.polynomial() - e3 * Fraction(1, 2) * d**4
    assert len(rest) == 0


# -- identification --------------------------------------------------------------------------


def test_the_truth_is_found_and_proved(fit: MomentFit, tmp_path: Path) -> None:
    assert percent(fit.model) < 2.0
    path = write(tmp_path, fit.model.document(), fit.proof.document(fit.model, "model.json"))
    verdict = check(path)
    assert "for every input" in verdict.statement
    assert verdict.margin == pytest.approx(1 - fit.proof.rate)
    assert "proved stable" in str(fit)


def test_without_bias_removal_the_model_is_far_worse(fit: MomentFit) -> None:
    runs = pair(4000, 1)
    naive = minimise_moment_rie(plain_moments(runs, CLASS, OFFSETS), CLASS, runs[0], OFFSETS)
    assert percent(naive.model) > 3.0 * percent(fit.model)


def test_the_error_falls_with_more_data() -> None:
    def mean_error(samples: int) -> float:
        fits = [
            identify_from_repeats(Dataset(pair(samples, seed, noise=0.2)), CLASS)
            for seed in range(4)
        ]
        return float(np.mean([percent(found.model) for found in fits]))

    errors = [mean_error(samples) for samples in (400, 4000, 20_000)]
    assert errors[2] < 0.5 * errors[1] < 0.3 * errors[0]


def test_the_bound_is_above_the_simulation_error_without_noise() -> None:
    trial = run(np.random.default_rng(4).uniform(-2, 2, 2000), 0.0, 4)
    small = MonotoneClass(1, (0,))  # a model that cannot be exact
    found = minimise_moment_rie(plain_moments([trial], small, OFFSETS), small, trial, OFFSETS)
    simulated = found.model.simulate(trial.u, trial.y[:1, 0])
    error = float(np.mean((simulated - trial.y[:, 0])[1:] ** 2))
    assert 0 < error <= found.bound


def test_the_bound_is_zero_where_the_model_is_exact() -> None:
    trial = run(np.random.default_rng(4).uniform(-2, 2, 500), 0.0, 4)
    moments = plain_moments([trial], CLASS, OFFSETS)
    assert moment_bound(truth(), moments) < 1e-6 * float(np.var(trial.y))


def test_the_rie_of_a_linear_model_is_not_below_its_lower_bound() -> None:
    """Prop 2.19: ≥ sup over |z| = 1 of the equation error through (zI - A)⁻¹, averaged."""
    rng = np.random.default_rng(8)
    one = MonotoneClass(2, (0,), 1)
    for poles in ((0.5, -0.3), (0.8, 0.4)):
        a = -np.poly(poles)[1:]
        model = replace(truth(), e=np.array([1.0, 0, 0]), a=a, b=np.ones(1), c=0.0)
        w = rng.standard_normal(400)
        y = lfilter([1.0], np.poly(poles), w) + 0.3 * rng.standard_normal(400)
        trial = Trajectory(t=0.01 * np.arange(400), y=y, u=w)
        moments = plain_moments([trial], one, OFFSETS)
        errors = y[2:] - a[0] * y[1:-1] - a[1] * y[:-2] - w[2:]
        z = np.exp(1j * np.linspace(0, np.pi, 400))
        gain = np.abs(z / (z**2 - a[0] * z - a[1])) ** 2
        assert moment_bound(model, moments) >= 0.999 * gain.max() * np.mean(errors**2)


def test_first_order_rie_is_the_bound_of_proposition_3_1() -> None:
    rng = np.random.default_rng(9)
    one = MonotoneClass(1, (0,), 1)
    for pole in (0.9, -0.6, 0.2):
        model = replace(truth(), e=np.array([1.0, 0, 0]), a=np.array([pole]), b=np.ones(1), c=0.0)
        w, y = rng.standard_normal((2, 500))
        trial = Trajectory(t=0.01 * np.arange(500), y=y, u=w)
        error = float(np.mean((y[1:] - pole * y[:-1] - w[1:]) ** 2))
        found = moment_bound(model, plain_moments([trial], one, OFFSETS))
        # δ of the stability condition raises the bound a little.
        assert found == pytest.approx(error / (1 - abs(pole)) ** 2, rel=0.02)
        assert found >= error / (1 - abs(pole)) ** 2 * (1 - 1e-6)


def test_the_bound_is_lipschitz_in_the_moments() -> None:
    """Prop 3.7: |J(a, M) - J(a, N)| ≤ κ|M - N|_F."""
    kappa = 60.0
    first, second = (
        plain_moments([run(np.random.default_rng(s).uniform(-2, 2, 300), 0.1, s)], CLASS, OFFSETS)
        for s in (1, 2)
    )
    J, K = (moment_bound(truth(), moments, kappa=kappa) for moments in (first, second))
    distance = float(np.linalg.norm(first.matrix() - second.matrix()))
    assert 0 < abs(J - K) <= kappa * distance


def test_a_smaller_kappa_never_lowers_the_bound() -> None:
    runs = pair(500, 3)
    moments = plain_moments(runs, CLASS, OFFSETS)
    free = minimise_moment_rie(moments, CLASS, runs[0], OFFSETS)
    size = float(np.linalg.norm(free.R))
    bounds = [free.bound]
    for part in (0.6, 0.4):
        bounded = minimise_moment_rie(moments, CLASS, runs[0], OFFSETS, kappa=part * size)
        assert np.linalg.norm(bounded.R) <= part * size * (1 + 1e-5)
        bounds.append(bounded.bound)
    assert 0 < bounds[0] < bounds[1] < bounds[2]


def test_direct_minimisation_reaches_the_noise_and_least_squares_does_not() -> None:
    runs = pair(3000, 2)
    plain = plain_moments(runs, CLASS, OFFSETS)
    squares = least_squares_equation(plain, CLASS, runs[0], OFFSETS)
    start = replace(squares, e=np.array([1.0, 0.0, 1.0]), a=np.zeros(2), b=np.zeros(1), c=0.0)
    direct = minimise_monotone_simulation_error(start, runs)
    assert percent(direct) < 1.0 < percent(squares)


# -- repeats ---------------------------------------------------------------------------------


def test_repeats_pass_and_what_is_not_a_repeat_is_named() -> None:
    first, second = pair(1500, 1)
    assert compare_repeats(first, second).passed
    assert "nothing contradicts" in str(compare_repeats(first, second))
    other = pair(1500, 2)[1]
    late = replace(second, y=np.roll(second.y, 1))
    stronger = replace(second, y=1.15 * second.y)
    for stranger, reason in ((other, "excitations differ"), (late, "correlates"),
                             (stronger, "correlates")):  # fmt: skip
        test = compare_repeats(first, stranger)
        assert not test.passed
        assert reason in str(test)
        data = Dataset((first, replace(stranger, group=first.group)))
        with pytest.raises(DataError, match="are not repeats"):
            identify_from_repeats(data, CLASS)


def test_true_repeats_are_hardly_ever_refused() -> None:
    refused = [not compare_repeats(*pair(400, seed)).passed for seed in range(60)]
    assert sum(refused) == 0


def test_coloured_noise_and_excitation_do_not_look_like_a_false_repeat() -> None:
    refused = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        w, *noises = (lfilter([1.0], [1.0, -0.95], rng.standard_normal(1000)) for _ in range(3))
        t = 0.01 * np.arange(1000)
        runs = [Trajectory(t=t, y=w + noise, u=w, name=str(k)) for k, noise in enumerate(noises)]
        refused += not compare_repeats(*runs).passed
    assert refused <= 1


def test_unusable_repeats_say_what_is_wrong() -> None:
    first, second = pair(400, 1)
    alone = Dataset((replace(first, group=""), replace(second, group="")))
    with pytest.raises(DataError, match="share a `group`"):
        identify_from_repeats(alone, CLASS)
    with pytest.raises(DataError, match="two repeats"):
        repeated_moments([[first]], CLASS, OFFSETS)
    with pytest.raises(DataError, match="common samples"):
        compare_repeats(*pair(50, 1))
    short = pair(2, 1)
    with pytest.raises(DataError, match="needed"):
        repeated_moments([short], CLASS, OFFSETS)
    with pytest.raises(ShapeError, match="one output"):
        offsets_of([replace(first, y=np.zeros((400, 2)), y_names=(), y_units=(), y_paths=())])
    with pytest.raises(DataError, match="degree 2"):
        MonotoneClass(1, (0,), 2)


# -- the certificate -------------------------------------------------------------------------


def write(folder: Path, model: Json, proof: Json) -> Path:
    """Write both with matching digests: only the mathematics can refuse."""
    (folder / "model.json").write_text(json.dumps(model))
    proof = json.loads(json.dumps(proof))
    proof["claim"]["about"]["model"]["digest"] = _json.digest(model)
    path = folder / "model.proof.json"
    path.write_text(json.dumps(proof_document(proof["claim"], proof["proof"])))
    return path


def _scaled_lags(model: Json) -> None:
    model["a"] = [4.0 * entry for entry in model["a"]]


def _flatter(model: Json) -> None:
    model["e"][0] *= 0.5


def _steeper_square(model: Json) -> None:
    model["e"][1] = 5.0


@pytest.mark.parametrize("change", [_scaled_lags, _flatter, _steeper_square])
def test_another_model_with_right_digests_is_rejected(
    tmp_path: Path, documents: tuple[Json, Json], change: Callable[[Json], None]
) -> None:
    model, proof = documents
    model = json.loads(json.dumps(model))
    change(model)
    with pytest.raises(CertificateRejected):
        check(write(tmp_path, model, proof))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda P: -P, "not symmetric positive definite"),
        (lambda P: 3.0 * P, "does not shrink"),
        (lambda P: 1e-3 * P, "does not shrink"),
        (lambda P: P + np.array([[0.0, 1e-9], [0.0, 0.0]]), "not symmetric"),
        (lambda P: P[:1, :1], "should have shape"),
    ],
)
def test_a_forged_storage_function_is_rejected(
    tmp_path: Path,
    documents: tuple[Json, Json],
    change: Callable[[FloatArray], FloatArray],
    reason: str,
) -> None:
    model, proof = documents
    forged = json.loads(json.dumps(proof))
    forged["proof"]["P"] = change(np.array(proof["proof"]["P"])).tolist()
    with pytest.raises(CertificateRejected, match=reason):
        check(write(tmp_path, model, forged))


def test_a_faster_rate_and_another_model_are_rejected(
    tmp_path: Path, documents: tuple[Json, Json]
) -> None:
    model, proof = documents
    for rate in (0.3, 1.0, -0.9):
        faster = json.loads(json.dumps(proof))
        faster["claim"]["rate"] = rate
        with pytest.raises(CertificateRejected):
            check(write(tmp_path, model, faster))
    path = write(tmp_path, model, proof)
    (tmp_path / "model.json").write_text(json.dumps(truth().document()))
    with pytest.raises(CertificateMismatch):
        check(path)


def test_the_proof_holds_on_pairs_of_solutions(fit: MomentFit) -> None:
    rng, P = np.random.default_rng(0), fit.proof.P
    for _ in range(20):
        u = rng.uniform(-20.0, 20.0, 40)
        first, second = (fit.model.simulate(u, rng.normal(scale=5.0, size=2)) for _ in range(2))
        gap = first - second
        V = np.array([[gap[t], gap[t - 1]] @ P @ [gap[t], gap[t - 1]] for t in range(1, 40)])
        assert (V[1:] <= fit.proof.rate**2 * V[:-1] * (1 + 1e-9) + 1e-20).all()


def test_moments_hold_their_class() -> None:
    moments = plain_moments(pair(100, 1), MonotoneClass(2, (0,), 1), OFFSETS)
    assert isinstance(moments, Moments)
    assert moments.degree == 1
    assert moments.matrix().shape == (5, 5)
