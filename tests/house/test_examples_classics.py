"""The classics: what is computed is the published value, and the proof file is accepted."""

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from examples import (
    choi_lam,
    matrix_positivstellensatz,
    moore_greitzer,
    motzkin,
    robinson,
    six_hump_camel,
    too_large_a_level,
    van_der_pol,
)
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateRejected, Infeasible
from nlsid_core.proofs import check, proof_document
from nlsid_core.sos.exact import exact_gram
from nlsid_core.sos.search import attraction, lower_bound, lyapunov

CLASSICS = {
    motzkin: 0.0,
    robinson: 0.0,
    choi_lam: 0.0,
    six_hump_camel: 1e-7,
    matrix_positivstellensatz: 1e-6,
    moore_greitzer: 0.0,
    van_der_pol: 5e-3,
    too_large_a_level: 0.05 * 1.1e-6,
}
SINGULAR = {motzkin, robinson, choi_lam}


def name_of(module: ModuleType) -> str:
    return module.__name__


@pytest.mark.parametrize("module", CLASSICS, ids=name_of)
def test_the_classic_reaches_its_published_value(module: ModuleType) -> None:
    computed, published = module.example()
    assert computed == pytest.approx(published, abs=CLASSICS[module])


@pytest.mark.parametrize("module", CLASSICS, ids=name_of)
def test_the_proof_of_the_classic_is_accepted_exactly(module: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "classic.proof.json"
    files.write_document(path, module.document())
    verdict = check(path)
    assert str(verdict).startswith("PROVED")
    assert (verdict.margin == 0) == (module in SINGULAR)


def test_a_level_below_the_largest_is_in_the_sentence(tmp_path: Path) -> None:
    path = tmp_path / "level.proof.json"
    files.write_document(path, too_large_a_level.document(0.0499))
    assert "<= 0.0498999999999}" in check(path).statement  # the float64 is below 0.0499


@pytest.mark.parametrize("module", [motzkin, robinson, choi_lam], ids=name_of)
def test_nonnegative_polynomials_that_are_no_sums_of_squares_are_refused(
    module: ModuleType,
) -> None:
    p = {motzkin: motzkin.MOTZKIN, robinson: robinson.ROBINSON, choi_lam: choi_lam.CHOI_LAM}[module]
    with pytest.raises(Infeasible):
        exact_gram(p, zeros=module.ZEROS)


def test_no_bound_of_the_motzkin_polynomial_is_a_sum_of_squares() -> None:
    with pytest.raises(Infeasible):
        lower_bound(motzkin.MOTZKIN)


def test_a_camel_bound_above_the_minimum_is_rejected() -> None:
    document = six_hump_camel.document()
    claim = document["claim"] | {"bound": -1.0316}
    forged = proof_document(claim, document["proof"])
    with pytest.raises(CertificateRejected):
        _check(forged)


def test_the_jet_engine_has_no_quadratic_lyapunov_function_we_can_prove() -> None:
    with pytest.raises(Infeasible):
        lyapunov(moore_greitzer.FIELD, degree=2)


def test_the_van_der_pol_level_is_the_largest_by_direct_minimisation() -> None:
    """The least V on V̇ = 0, along rays: V̇ = r²(a + b r²) vanishes at r² = -a/b."""
    rate = sum(
        van_der_pol.V.derivative(name) * f
        for name, f in zip(("x", "y"), van_der_pol.FIELD, strict=True)
    )

    def level(angle: float) -> float:
        ray = np.array([np.cos(angle), np.sin(angle)])
        square, quartic = rate.homogeneous(2)(ray), rate.homogeneous(4)(ray)
        return float(van_der_pol.V(ray) * -square / quartic) if quartic > 0 else 1e9

    angles = np.linspace(0, np.pi, 2001)
    rough = angles[np.argmin([level(a) for a in angles])]
    exact = minimize_scalar(level, bounds=(rough - 0.01, rough + 0.01), method="bounded").fun
    computed = van_der_pol.example()[0]
    assert exact * (1 - 3e-4) < computed <= exact


def test_levels_below_one_twentieth_are_proved_and_above_refused() -> None:
    assert attraction(too_large_a_level.FIELD, too_large_a_level.V, 0.0499).level == 0.0499
    for level in (0.0501, 0.05 * (1 + 1e-6), 0.067):
        with pytest.raises(Infeasible):
            attraction(too_large_a_level.FIELD, too_large_a_level.V, level)


def test_a_proof_for_one_level_is_rejected_for_a_larger_one() -> None:
    document = too_large_a_level.document(0.0499)
    claim = document["claim"] | {"level": 0.0501}
    forged = proof_document(claim, document["proof"])
    with pytest.raises(CertificateRejected):
        _check(forged)


def _check(document: Json) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "forged.proof.json"
        files.write_document(path, document)
        check(path)
