"""Stable sets: the polynomials that the kernel rebuilds are those of the page, term by term."""

from fractions import Fraction
from typing import Any

import pytest

from nlsid_core.kernel import Rejected, positivity, stable_set
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.implicit_models import read_implicit
from tests.core.kernel import mutations
from tests.core.kernel import oracle_polynomial as oracle
from tests.core.kernel.mutations import Case

CASES = [case for case in mutations.corpus() if case.kind == "stable_set"]


@pytest.mark.parametrize("what", ["states", "inputs"])
def test_two_of_one_name_are_refused(what: str) -> None:
    (model,) = CASES[0].copied().about.values()
    model[what] = ["a", "a"]
    with pytest.raises(Rejected, match=f"two {what} have the same name"):
        read_implicit(parse(mutations.encoded(model), "model"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_kernels_polynomials_are_the_oracles_exactly(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, oracle.P] = {}
    decided = positivity.positive

    def watched(c: Any, squares: Any, ring: Any, what: str, *, strict: bool) -> None:
        terms = {bytes(ring.exponents(k)): Fraction(v, c.denominator) for k, v in c.terms.items()}
        seen[what] = oracle.P(ring.count, {tuple(e): c for e, c in terms.items()})
        decided(c, squares, ring, what, strict=strict)

    monkeypatch.setattr(stable_set, "positive", watched)
    assert mutations.decide(case) == "proved"
    claim, proof = case.document["claim"], case.document["proof"]
    model = case.about[claim["about"]["model"]["file"]]
    expected = oracle.stable_inequalities(claim, proof, model)
    assert set(seen) == {f"inequality {name}" for name in expected}
    for name, (c, domain) in expected.items():
        for multiplier in proof["inequalities"][name].get("multipliers", []):
            c = c - oracle.squares(multiplier, c.n)[0] * domain[multiplier["of"]]
        assert seen[f"inequality {name}"].terms == c.terms
