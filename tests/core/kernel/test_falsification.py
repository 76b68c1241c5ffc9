"""The claim `falsification`: decided as exact arithmetic says, refused where a state explains."""

import json
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.designs.documents import load_proved
from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.documents import read
from nlsid_core.errors import CertificateMismatch, CertificateRejected, DataError, NlsidError
from nlsid_core.funnels.level import LevelMeter
from nlsid_core.funnels.tube import Tube
from nlsid_core.models import StableModel
from nlsid_core.running.falsification import falsifications
from nlsid_core.running.stepping import Stepper
from tests.core.kernel import oracle_falsification as oracle
from tests.core.kernel import tube_claims
from tests.core.kernel.falsification_claims import (
    MODELS,
    PROOF,
    RECORDING,
    bind_again,
    binding,
    broken_run,
    claim,
    found,
    funnel_of,
)
from tests.core.kernel.mutations import corpus
from tests.core.kernel.oracle_stability import exact, solved
from tests.marks import slow_among

EVERY = pytest.mark.parametrize("name", MODELS)
Change = Callable[[Json, dict[str, Json]], Any]


def model_of(about: dict[str, Json]) -> Any:
    """The model of these files."""
    return read(about["model.json"], source="model.json")


def decided(document: Json, about: dict[str, Json]) -> bool:
    """Whether the kernel says FALSIFIED; the tube's digest is made to fit."""
    document["claim"]["about"] = binding(about)
    try:
        proofs.decide(document, about)
    except CertificateRejected:
        return False
    return True


@EVERY
def test_a_broken_sensor_is_falsified(name: str) -> None:
    document, about = claim(name)
    verdict = proofs.decide(document, about)
    assert verdict.kind == "falsification"
    assert verdict.margin > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", [*MODELS, "two_following"])
def test_one_is_found_for_every_design_of_its_classes(name: str) -> None:
    document, about = found(tube_claims.design(name))
    assert oracle.agrees(document, about)


def test_the_sentence_is_that_of_the_page() -> None:
    document, about = claim("following")
    first, last = document["claim"]["first"], document["claim"]["first"] + 3
    document["proof"]["peak"] = [0.0] * 4
    said = str(proofs.decide(document, about)).splitlines()
    tube = about["funnel.json"]["tubes"][0]
    assert said[0].startswith(
        f'FALSIFIED the assumption of tube 1 of {files.digest(about[PROOF])} on "a run", samples '
        f"{first} to {last}, which span 0.075 s: whatever the observer's state at sample {first}, "
        f"every run of the tube's observer through them that counts E from sample {first} or "
        "before, g counted from sample 0, breaks E <= "
    )
    assert f" (m/s)^2 g after every sample, E+ = {tube['rho']} E + e^2 from 0, g = " in said[0]
    assert "e^2 <= " not in said[0]
    assert ", margin " in said[0]
    assert said[1:] == [
        f"  assuming samples 0 to {last} of the recording {RECORDING['digest']} are those that "
        "the file states"
    ]


def test_a_peak_alone_says_nothing_of_e() -> None:
    """The weights of Farkas: one of the single innovations is too large, whatever E was."""
    document, about = claim("linear")
    document["proof"] = {"energy": [0.0] * 4, "peak": [1.0] * 4}
    said = str(proofs.decide(document, about))
    assert "through them breaks e^2 <= " in said
    assert "counts" not in said
    assert "E+" not in said
    assert oracle.agrees(document, about)
    document["proof"]["energy"][3] = 1.0
    said = str(proofs.decide(document, about))
    assert "that counts E from sample " in said
    assert " or e^2 <= " in said


# -- what is true ----------------------------------------------------------------------------


def energies(document: Json, about: dict[str, Json], x: list[Fraction]) -> list[Fraction]:
    """E after every sample of the window, of the observer that is at x at its first; exact."""
    model, tube = about["model.json"], about["funnel.json"]["tubes"][0]
    run, first, u, y = oracle.samples_of(document["claim"], model)
    R = [[exact(entry) for entry in row] for row in tube["R"]]
    found, E = [], Fraction(0)
    for e in oracle.innovations(model, tube, u, y, run, first, x):
        E = exact(tube["rho"]) * E + oracle.bilinear(e, R, e)
        found.append(E)
    return found


def best_state(document: Json, about: dict[str, Json]) -> list[Fraction]:
    """The observer's state that leaves the least E after the window, by the normal equations.

    The gradient of that form is affine: it is sampled at 0 and the unit vectors.
    """
    n = len(about["funnel.json"]["tubes"][0]["P"])

    def last(x: list[Fraction]) -> Fraction:
        return energies(document, about, x)[-1]

    def moved(*units: int) -> Fraction:
        return last([Fraction(units.count(i)) for i in range(n)])

    base, single = moved(), [moved(i) for i in range(n)]
    H = [[moved(i, j) - single[i] - single[j] + base for j in range(n)] for i in range(n)]
    g = [[-(single[i] - base - H[i][i] / 2)] for i in range(n)]
    return [row[0] for row in solved(H, g)]


@pytest.mark.parametrize("name", ["linear", "quadratic", "two_outputs"])
def test_the_smallest_false_neighbour_is_refused(name: str) -> None:
    """The outputs are moved towards those that the best state predicts, until it explains them.

    One step of the fault's size before that the kernel says FALSIFIED, one after it does not.
    """
    document, about = claim(name)
    x = best_state(document, about)
    tube = about["funnel.json"]["tubes"][0]
    least, level = energies(document, about, x)[-1], exact(tube["level"])
    margin = proofs.decide(document, about).margin
    assert least > level
    assert abs(margin - (least / level - 1)) < Fraction(1, 10**15) * margin
    funnel = about["funnel.json"]
    for room, is_false in ((Fraction(1, 10**14), False), (-Fraction(1, 10**14), True)):
        forged = json.loads(json.dumps(about))
        raised = float(least * (1 + room))  # a level of the tube just above and just below
        share = (raised / float(level)) ** 0.5 * 1.001
        changed = forged["funnel.json"]["tubes"][0]
        changed["level"] = raised
        changed["half_widths"] = [width * share for width in changed["half_widths"]]
        assert funnel["tubes"][0]["level"] == float(level)
        bind_again(forged)
        assert decided(document, forged) == is_false
        assert oracle.agrees(document, forged) == is_false


@EVERY
def test_no_state_that_is_tried_keeps_the_assumption(name: str) -> None:
    document, about = claim(name)
    tube, rng = about["funnel.json"]["tubes"][0], np.random.default_rng(4)
    _, first, u, _ = oracle.samples_of(document["claim"], about["model.json"])
    g = [Fraction(1)] * len(u)
    if "follows" in tube:
        g = oracle.levels(tube["follows"], u)
    g = g[first - document["claim"]["run"] :]
    best = best_state(document, about)
    for size in [0.0, *np.repeat([1e-3, 0.03, 1.0, 30.0], 5)]:
        x = [entry + exact(float(step)) for entry, step in
             zip(best, size * rng.normal(size=len(best)), strict=True)]  # fmt: skip
        kept = energies(document, about, x)
        assert any(exact(tube["level"]) * now < E for E, now in zip(kept, g, strict=True))


def kept_run(
    model: StableModel, tube: Tube, samples: int, seed: int
) -> tuple[FloatArray, FloatArray]:
    """(y, u) that an observer makes of innovations near all that its tube assumes."""
    rng, stepper = np.random.default_rng(seed), Stepper(model)
    p, n_u, lags = len(stepper.y), len(stepper.u), max(stepper.lags, 1)
    u = np.repeat(rng.uniform(tube_claims.LOW, tube_claims.HIGH, (samples // 5, n_u)), 5, axis=0)
    y = np.zeros((samples, p))
    x = stepper.begin(y[:lags], u[:lags])[None]
    meter, spent = None if tube.follows is None else LevelMeter(tube.follows), 0.0
    for t in range(samples):
        g = 1.0 if meter is None else meter.update(u[t].tolist())[0]
        if t < lags:
            continue
        outputs, x = stepper.advance(x, u[t])
        e = np.sign(rng.normal(size=p)) * rng.random(p)
        most = 0.999 * tube.level * g - tube.rho * spent
        if tube.peak is not None:
            most = min(most, 0.999 * tube.peak.level * max(1.0, g))
        e = e * np.sqrt(max(most, 0.0) / (e @ tube.R @ e))
        spent = tube.rho * spent + float(e @ tube.R @ e)
        y[t], x = outputs[0] + e, x + tube.L @ e
    return y, u


@pytest.mark.parametrize("name", slow_among(MODELS, {"two_outputs", "moving_lags"}))
def test_a_run_that_keeps_the_assumption_is_not_falsified(name: str) -> None:
    """Whatever the weights are, and wherever the window is."""
    _, about = claim(name)
    model, funnel, rng = model_of(about), funnel_of(about), np.random.default_rng(2)
    stepper = Stepper(model)
    for seed in range(3):
        y, u = kept_run(model, funnel.tubes[0], 60, seed)
        assert all(each.tube > 1 for each in falsifications(model, funnel, y, u))
        for _ in range(5):
            length = int(rng.integers(1, 9))
            a = int(rng.integers(2 * stepper.lags, 60 - length))
            energy = rng.random(length) * (rng.random(length) < 0.5)
            peak = rng.random(length) * (rng.random(length) < 0.5)
            said = {"kind": "falsification", "about": binding(about), "recording": RECORDING,
                    "tube": 1, "run": 0, "first": a, "u": u[: a + length].tolist(),
                    "y": y[a : a + length].tolist()}  # fmt: skip
            document = proofs.proof_document(
                said, {"energy": energy.tolist(), "peak": peak.tolist()}
            )
            assert not decided(document, about)


def test_longer_windows_lose_nothing_that_matters_by_rounding() -> None:
    """Of 40 samples the margin is the exact one to 15 digits; the numbers do not grow."""
    _, about = claim("linear")
    y, u = broken_run(model_of(about))
    energy = np.zeros(40)
    energy[-1] = 1.0
    said = {"kind": "falsification", "about": binding(about), "recording": RECORDING, "tube": 1,
            "run": 10, "first": 10, "u": u[10:50].tolist(), "y": y[10:50].tolist()}  # fmt: skip
    document = proofs.proof_document(said, {"energy": energy.tolist(), "peak": [0.0] * 40})
    margin = proofs.decide(document, about).margin
    least = energies(document, about, best_state(document, about))[-1]
    level = exact(about["funnel.json"]["tubes"][0]["level"])
    true = least / level - 1
    assert 0 < true - margin < true / 10**15


# -- what is refused -------------------------------------------------------------------------


def scaled_outputs(document: Json, _: dict[str, Json]) -> None:
    """As small as the noise."""
    y = document["claim"]["y"]
    document["claim"]["y"] = [[1e-6 * entry for entry in row] for row in y]


FORGERIES: dict[str, tuple[Change, str]] = {
    "outputs that a state explains": (scaled_outputs, "a state of the observer can explain"),
    "a negative weight": (lambda d, _: d["proof"]["energy"].__setitem__(0, -1.0), "0 or more"),
    "no weights": (
        lambda d, _: d["proof"].update(energy=[0.0] * 4), "as a form in the observer's state"
    ),
    "a window of one sample": (
        lambda d, _: (d["claim"].update(y=d["claim"]["y"][:1], u=d["claim"]["u"][:1]),
                      d["proof"].update(energy=[1.0], peak=[0.0])),
        "as a form in the observer's state",
    ),
    "a weight too few": (lambda d, _: d["proof"]["energy"].pop(), "should have shape"),
    "another sample count": (lambda d, _: d["claim"]["u"].pop(), "inputs should go from"),
    "inputs that begin later": (
        lambda d, _: d["claim"].update(run=d["claim"]["first"] + 1), "inputs should go from"
    ),
    "an energy over some samples": (lambda d, _: d["claim"].update(tube=2), "assumed for ever"),
    "a tube that is not there": (lambda d, _: d["claim"].update(tube=3), "from 1 to 2"),
    "a recording without a digest": (
        lambda d, _: d["claim"]["recording"].update(digest=""), "digest of its recording"
    ),
    "a recording that is a window": (
        lambda d, _: d["claim"]["recording"].update(digest=f"{RECORDING['digest']}[0:9]"),
        "should be a whole one",
    ),
    "a tube that is not proved": (
        lambda _, about: about["funnel.json"]["tubes"][0].update(rho=0.3),
        "is not positive definite",
    ),
    "a level below what was measured": (
        lambda _, about: about["funnel.json"]["tubes"][0].update(level=1e-9),
        "below safety_factor",
    ),
    "an unknown member": (lambda d, _: d["claim"].update(sure=True), "unknown member"),
}  # fmt: skip


# What the oracle, which knows no formats, does not look at.
OF_FORM = ("an unknown member", "a recording without a digest", "a recording that is a window")


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_forged_one_is_refused(forgery: str) -> None:
    document, about = claim("linear")
    change, reason = FORGERIES[forgery]
    change(document, about)
    bind_again(about)
    document["claim"]["about"] = binding(about)
    with pytest.raises(CertificateRejected, match=reason):
        proofs.decide(document, about)
    if forgery not in OF_FORM:
        assert not oracle.agrees(document, about)


def test_a_tube_without_a_peak_has_no_peak_to_break() -> None:
    document, about = claim("two_outputs")
    del about["funnel.json"]["tubes"][0]["peak"]
    bind_again(about)
    assert decided(document, about)
    document["proof"]["peak"] = document["proof"]["energy"]
    assert not decided(document, about)


def test_files_of_another_tube_are_refused() -> None:
    document, about = claim("linear")
    about[PROOF]["claim"]["about"]["model"]["file"] = "other.json"
    with pytest.raises(CertificateMismatch, match=r"funnel\.proof\.json is not the tube"):
        proofs.decide(document, about)


def test_inputs_that_the_model_refuses_and_those_it_clips() -> None:
    document, about = claim("quadratic")
    model = about["model.json"]
    assert model["on_out_of_range"] == "clip"
    low, high = model["u_range"][0]
    document["claim"]["u"][-1] = [high + 5.0]
    clipped = decided(document, about)
    assert clipped == oracle.agrees(document, about)
    document["claim"]["u"][-1] = [high]
    assert decided(document, about) == clipped
    model["on_out_of_range"] = "refuse"
    bind_again(about)
    assert decided(document, about) == clipped
    document["claim"]["u"][-1] = [low - 1e-9]
    document["claim"]["about"] = binding(about)
    with pytest.raises(CertificateRejected, match="beyond the range"):
        proofs.decide(document, about)


def test_inputs_have_to_reach_back_as_far_as_the_model_does() -> None:
    document, about = claim("quadratic")
    said = document["claim"]
    reach = said["first"] - said["run"]
    assert reach > 0
    said.update(run=said["first"], u=said["u"][reach:])
    with pytest.raises(CertificateRejected, match="should begin earlier"):
        proofs.decide(document, about)
    assert not oracle.agrees(document, about)


@pytest.mark.slow
def test_a_window_that_would_take_minutes_is_refused_before_it_is_decided() -> None:
    document, about = claim("linear")
    count = 16_000
    document["claim"].update(u=[[0.1]] * count, y=[[3.0]] * count)
    document["proof"] = {"energy": [1.0] * count, "peak": [0.0] * count}
    with pytest.raises(CertificateRejected, match="too many samples"):
        proofs.decide(document, about)


def test_models_that_are_not_affine_in_their_states_are_refused_by_name() -> None:
    (case,) = (case for case in corpus() if case.name == "lasting_network")
    about = case.copied().about | {PROOF: case.document}
    model = model_of(about)
    y, u = broken_run(model)
    with pytest.raises(DataError, match="linear and state_affine ones; this is a CellNetwork"):
        next(falsifications(model, funnel_of(about), y, u))
    said = {"kind": "falsification", "about": binding(about), "recording": RECORDING, "tube": 1,
            "run": 0, "first": 0, "u": u.tolist(), "y": y.tolist()}  # fmt: skip
    nothing = [0.0] * len(y)
    document = proofs.proof_document(said, {"energy": [1.0, *nothing[1:]], "peak": nothing})
    with pytest.raises(CertificateRejected, match="not of kind cell_network"):
        proofs.decide(document, about)


def test_a_falsification_is_no_proof_of_a_funnel(tmp_path: Path) -> None:
    """In the place of the proof beside a funnel it lets nothing run."""
    document, about = claim("linear")
    for name, content in about.items():
        files.write_document(tmp_path / name, content)
    assert load_proved(tmp_path / "funnel.json").verdict.kind == "tube"
    about["tube.proof.json"] = about.pop(PROOF)
    document["claim"]["about"]["tube"]["file"] = "tube.proof.json"
    files.write_document(tmp_path / "tube.proof.json", about["tube.proof.json"])
    files.write_document(tmp_path / PROOF, document)
    assert proofs.check(tmp_path / PROOF).kind == "falsification"
    with pytest.raises(NlsidError):
        load_proved(tmp_path / "funnel.json")
