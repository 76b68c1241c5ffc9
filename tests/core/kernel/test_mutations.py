"""The corpus of version 2: still proved, its false neighbours refused, no mutant wrongly proved."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from nlsid_core import files, kernel, proofs
from nlsid_core.errors import CertificateMismatch
from nlsid_core.kernel import Rejected
from tests.core.kernel import mutations, oracle_composition
from tests.core.kernel.mutations import CORPUS, ORACLES, PROOF, Case, corpus
from tests.core.kernel.refusals import refused
from tests.edits import Edit, put, without
from tests.funnel_files import forged_by

CASES = pytest.mark.parametrize("case", corpus(), ids=lambda case: f"{case.kind}/{case.name}")
LEFT = CORPUS.parent / "left"
FALSE: dict[str, Edit] = {  # a claim that is false, by one number of it
    "stable_set/linear": put("claim delta", 10.0),
    "stability/linear": put("claim rate", 0.6),  # the slowest pole is at 0.68
    "stability/cascade": put("claim rate", 0.7071),  # the slowest pole is at √½
    "continuous_funnel/pushed": put("proof kappa 1 1", -1.0),
}


@CASES
def test_a_case_of_the_corpus_is_proved_and_its_oracle_agrees(case: Case) -> None:
    assert mutations.decide(case) == "proved"
    assert ORACLES[case.kind](case.document, case.about)
    content = (CORPUS / case.kind / case.name / PROOF).read_bytes()
    assert files.encode(case.document) == content  # what is decided here is the file's bytes


@pytest.mark.parametrize("tries", [6, pytest.param(60, marks=pytest.mark.slow)])
@CASES
def test_numbers_moved_at_random_are_decided_as_the_oracle_decides(case: Case, tries: int) -> None:
    """Each by a little or by its size: some claims stay true, others become false."""
    rng, found = np.random.default_rng(5), {"proved": 0, "rejected": 0}
    for _ in range(tries // 2 if case.kind == "continuous_funnel" else tries):
        forged = mutations.moved(case, rng)
        truth = ORACLES[case.kind](forged.document, forged.about)
        said = mutations.decide(forged)
        assert said == ("proved" if truth else "rejected")
        found[said] += 1
    assert tries < 60 or min(found.values()) > 0


@CASES
def test_a_changed_digit_or_a_missing_file_is_a_mismatch(case: Case) -> None:
    contents = {name: files.encode(document) for name, document in case.about.items()}
    for name, content in contents.items():
        digits = [i for i, sign in enumerate(content) if sign in b"12345678"]
        for i in digits[:: max(1, len(digits) // 12)]:
            other = content[:i] + bytes([content[i] + 1]) + content[i + 1 :]
            with refused("mismatch"):
                proofs.decide(case.document, contents | {name: other})
        with pytest.raises(CertificateMismatch, match=name):
            proofs.decide(case.document, {n: c for n, c in contents.items() if n != name})


DAMAGES = [
    *map(without, ("claim", "proof", "claim kind", "claim about")),
    *(
        put("claim about * file", name)
        for name in ("../model.json", "/etc/hostname", "a/b.json", "", "..\\x")
    ),
]


@CASES
def test_a_proof_without_a_member_or_about_files_elsewhere_is_malformed(case: Case) -> None:
    for damage in DAMAGES:
        with refused("malformed"):
            proofs.decide(forged_by(damage, case.document), case.about)


@pytest.mark.parametrize("name", FALSE)
def test_a_false_neighbour_is_refused(name: str) -> None:
    found = [case for case in corpus() if f"{case.kind}/{case.name}" == name]
    forged = found[0].copied()
    FALSE[name](forged.document)
    assert mutations.decide(forged) == "rejected"
    assert not ORACLES[forged.kind](forged.document, forged.about)


@pytest.mark.parametrize("folder", sorted(LEFT.iterdir()), ids=lambda folder: folder.name)
def test_a_proof_of_a_form_that_left_is_refused_by_name(folder: Path) -> None:
    """What version 0.2 proved and nothing makes since 0.3: decision 62."""
    with pytest.raises(Rejected, match=r"not decided since version 0\.3") as found:
        kernel.check(folder / PROOF)
    assert found.value.reason == "left"


def composed() -> Case:
    return next(case for case in corpus() if case.kind == "funnel_composition").copied()


def bound_again(forged: Case) -> str:
    """What the kernel decides of it, all digests fresh."""
    mutations.bind_again(forged)
    return mutations.decide(forged)


@pytest.mark.parametrize("share", [0.95, 0.985, 0.989, 1.0])
def test_a_stage_that_starts_narrower_than_the_one_before_ends_is_refused(share: float) -> None:
    """Stage 1 ends at 0.9901 of where stage 2 starts: below that its ends are outside."""
    forged = composed()
    before, after = (forged.about[f"stage{i}.funnel.json"] for i in (1, 2))
    after["rho"][0] *= share
    is_true = oracle_composition.worst_step(before, after) <= 1
    assert is_true == (share == 1.0)
    assert bound_again(forged) == ("proved" if is_true else "rejected")
    assert ORACLES[forged.kind](forged.document, forged.about) == is_true


@pytest.mark.parametrize("when", [0.25 - 2.0**-54, 0.25 + 2.0**-54])
def test_stages_meet_at_one_time_exactly(when: float) -> None:
    forged = composed()
    for name in ("stage2.funnel.json", "stage2.policy.json"):
        forged.about[name]["t"][0] = when
    assert bound_again(forged) == "rejected"
    assert not ORACLES[forged.kind](forged.document, forged.about)


@pytest.mark.parametrize("multiplier", [-1.0, 0.0, 0.99, 0.9902, 1.0, 1.0000001])
def test_the_multiplier_of_a_step_is_decided_as_the_page_says(multiplier: float) -> None:
    """Around one centre λP/ρ - Q/σ >= 0 and 1 - λ >= 0: λ from 0.99010 to 1."""
    forged = composed()
    forged.document["proof"]["multipliers"] = [multiplier]
    is_proved = 0.9901 < multiplier <= 1.0
    assert bound_again(forged) == ("proved" if is_proved else "rejected")
    assert ORACLES[forged.kind](forged.document, forged.about) == is_proved


def test_no_mutant_is_wrongly_proved() -> None:
    outcomes = mutations.run(100, np.random.default_rng(1))
    assert outcomes["false_proved"] == 0
    assert outcomes["not decided"] == 0, "a refusal without a reason of its own"
    assert outcomes["rejected"] > 50
    assert outcomes["proved"] > 3  # some are still proofs, and an oracle has confirmed them


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_no_mutant_of_twenty_thousand_is_wrongly_proved() -> None:
    """More of them: `python -m benchmarks.kernel --mutations N`."""
    with ProcessPoolExecutor(2) as pool:
        seeds = map(np.random.default_rng, (2, 3))
        for outcomes in pool.map(mutations.run, (10_000, 10_000), seeds):
            print(outcomes)
            assert outcomes["false_proved"] == outcomes["not decided"] == 0
