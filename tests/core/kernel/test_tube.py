"""The claim `tube` of every class of models: proved, its false neighbours refused, never left."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.errors import CertificateRejected
from tests.core.kernel import mutations
from tests.core.kernel import oracle_tube as oracle
from tests.core.kernel.refusals import refused
from tests.core.kernel.tube_claims import (
    FUNNEL,
    LONG,
    MODEL,
    MODELS,
    attacks,
    claim,
    decide,
    design,
)
from tests.marks import slow_among

EVERY = pytest.mark.parametrize("name", slow_among(MODELS, LONG))
Change = Callable[[SimpleNamespace], Any]


def test_the_sentences_are_those_of_the_page() -> None:
    model, funnel, proof = claim("linear")
    headline, energy = funnel["tubes"]
    share = 1 - headline["direct"][0] * headline["peak"]["at_most"][0] / headline["half_widths"][0]
    peak = f"{headline['peak']['at_most'][0]:.9f}"[:6]
    said = str(decide(model, funnel, proof)).splitlines()
    assert said[0].startswith(
        f"PROVED tube: the measured speed stays within {headline['half_widths'][0]:.3g} m/s of "
        "what the model predicts from the inputs alone, for every input, for ever, as long as its "
        f"assumptions hold (tube 1, inferred share speed {int(100 * share) / 100}); also within "
        f"{energy['half_widths'][0]:.3g} m/s for 40 samples, which span 0.975 s (tube 2), margin "
    )
    assert (
        said[1]
        == "  assuming after 3 samples (0.07501 s) the simulation starts at one state with the "
        "observers, one for each tube"
    )
    assert (
        f"E+ = {headline['rho']} E + e^2 from 0; the innovation of speed at most {peak}" in said[2]
    )
    assert "tube 2: innovation energy of its own observer: sum of e^2 <= " in said[3]
    assert len(said) == 4  # what was measured, and on what, is no part of the claim


def test_the_rule_of_a_level_by_commands_is_printed_with_every_number() -> None:
    model, funnel, proof = claim("following")
    terms = [
        {"inputs": [], "of": "value", "centre": 0.0, "scale": 1.0, "fading": 0.0},
        {"inputs": [0], "of": "value", "centre": 0.5, "scale": 2.0, "fading": 0.0},
        {"inputs": [0], "of": "change", "centre": 0.0, "scale": 1.5, "fading": 0.9},
    ]
    tubes(funnel)["follows"] = {"terms": terms, "weights": [[0.25, 3.0, 7.5]]}
    u = model["u"]
    said = str(decide(model, funnel, proof)).splitlines()
    name = u["name"] if u["name"].isidentifier() else f'"{u["name"]}"'
    unit = f" {u['unit']}".rstrip()
    assert " sqrt(g) for ever" in said[0]
    assert " g after every sample, E+ = " in said[2]
    assert said[2].endswith(
        f", g = 0.25 + 3 (({name} - 0.5{unit}) / 2{unit})^2 + 7.5 (sum 0.9^i "
        f"(change of {name} / 1.5{unit})^2), sums over the run's samples, each i samples ago"
    )


def test_the_change_of_a_product_is_not_the_product_of_a_change() -> None:
    model, funnel, proof = claim("following")
    term = {"inputs": [0, 0], "of": "change", "centre": 0.0, "scale": 1.0, "fading": 0.0}
    tubes(funnel)["follows"] = {"terms": [term], "weights": [[3.0]]}
    name = model["u"]["name"]
    said = decide(model, funnel, proof).assumptions[1]
    assert f"g = 3 (change of ({name} x {name}) / 1" in said


def test_an_input_with_the_outputs_name_is_told_apart_in_a_level_by_commands() -> None:
    model, funnel, proof = claim("following")
    term = {"inputs": [0], "of": "value", "centre": 0.0, "scale": 1.0, "fading": 0.0}
    tubes(funnel)["follows"] = {"terms": [term], "weights": [[3.0]]}
    name = model["u"]["name"] = model["y"]["name"]
    said = decide(model, funnel, proof).assumptions[1]
    assert f"g = 3 (input {name} / 1" in said


def test_one_observer_of_all_tubes_is_called_so() -> None:
    model, funnel, proof = claim("linear")
    funnel["tubes"] = funnel["tubes"][:1]
    said = decide(model, funnel, proof).assumptions
    assert said[0] == "after 3 samples (0.07501 s) the simulation starts at the observer's state"
    assert said[1].startswith("innovation energy: E <= ")


def test_two_outputs_of_one_name_are_refused() -> None:
    model, funnel, proof = made_before("lasting_two_outputs")
    model["y"][1]["name"] = model["y"][0]["name"]
    with refused("malformed"):
        decide(model, funnel, proof)


# -- what is refused -------------------------------------------------------------------------


def tubes(funnel: Json) -> Json:
    return funnel["tubes"][0]  # type: ignore[no-any-return]


def scaled(owner: Any, key: Any, factor: float) -> None:
    owner[key] = (np.array(owner[key]) * factor).tolist()


def first_assumption(funnel: Json) -> Json:
    return tubes(funnel)["assumption"]  # type: ignore[no-any-return]


CORPUS = {
    case.name: case
    for case in mutations.corpus()
    if case.kind == "tube" and "policy.json" not in case.about
}


def made_before(name: str) -> tuple[Json, Json, Json]:
    """Model and funnel of a case of the corpus, and its proof's witnesses."""
    case = CORPUS[name].copied()
    return case.about["model.json"], case.about["funnel.json"], case.document["proof"]


# Small enough that the claim is another one, large enough that it is false.
FALSE: dict[str, Change] = {
    "tau": lambda c: scaled(tubes(c.funnel), "tau", 1.003),
    "rho": lambda c: tubes(c.funnel).update(rho=0.9 * tubes(c.funnel)["rho"]),
    "R": lambda c: scaled(tubes(c.funnel), "R", 0.97),
    # Where hardly anything is injected, P has room for a factor of fifty.
    "P": lambda c: scaled(
        tubes(c.funnel), "P", 0.5 if np.abs(tubes(c.funnel)["L"]).max() > 1e-2 else 1e-3
    ),
    "L": lambda c: scaled(tubes(c.funnel), "L", 1.3),
    "half-width": lambda c: scaled(tubes(c.funnel), "half_widths", 0.98),
    # What the level bounds may be a small part of a half-width.
    "level": lambda c: scaled(
        tubes(c.funnel), "level", 9.0 if "direct" in tubes(c.funnel) else 1.03
    ),
    "inlet": lambda c: tubes(c.funnel).update(
        inlet=tubes(c.funnel)["level"] * (9.0 if "direct" in tubes(c.funnel) else 0.05)
    ),
    "no multiplier": lambda c: c.proof.clear() if c.proof else c.proof.update(multipliers=[]),
}


@pytest.mark.parametrize("name", CORPUS)
@pytest.mark.parametrize("what", FALSE)
def test_a_false_neighbour_is_refused(name: str, what: str) -> None:
    model, funnel, proof = made_before(name)
    FALSE[what](SimpleNamespace(model=model, funnel=funnel, proof=proof))
    assert not oracle.is_proved(model, funnel, proof)
    with pytest.raises(CertificateRejected):
        decide(model, funnel, proof)


def least_tau(name: str) -> tuple[float, float]:
    """tau up to which the oracle agrees, and 0.1 % above it."""
    model, funnel, proof = made_before(name)
    low, high = tubes(funnel)["tau"][0], 4.0 * tubes(funnel)["tau"][0]
    while high - low > 1e-6 * low:
        tubes(funnel)["tau"][0] = middle = 0.5 * (low + high)
        tubes(funnel)["half_widths"] = [1e3] * len(tubes(funnel)["tau"])
        if oracle.is_proved(model, funnel, proof):
            low = middle
        else:
            high = middle
    return low, 1.001 * low


@pytest.mark.parametrize(
    "name", ["lasting_linear", "lasting_monotone", "lasting_cascade", "lasting_implicit_ray"]
)
def test_tau_is_proved_up_to_the_oracles_limit_and_refused_a_tenth_of_a_percent_above(
    name: str,
) -> None:
    proved, false = least_tau(name)
    model, funnel, proof = made_before(name)
    tubes(funnel)["half_widths"] = [1e3] * len(tubes(funnel)["tau"])
    tubes(funnel)["tau"][0] = proved
    decide(model, funnel, proof)
    tubes(funnel)["tau"][0] = false
    with refused("not_definite"):
        decide(model, funnel, proof)


def with_a_direct_part(c: float = 0.6, peak: float = 0.02) -> tuple[Json, Json, Json]:
    """The linear model's tube with this part of every innovation bounded by its peak alone."""
    model, funnel, proof = claim("linear")
    tube = tubes(funnel)
    share = np.linalg.inv(tube["P"])[0, 0] / tube["rho"] + (1.0 - c) ** 2 / tube["R"][0][0]
    tau = 0.999 / share
    width = 1.001 * np.sqrt(tube["level"] / tau) + c * peak
    stated = {"at_most": [peak], "measured": [peak / 1.5]}
    tube |= {"direct": [c], "peak": stated, "tau": [tau], "half_widths": [width]}
    return model, funnel, proof


def test_a_direct_part_of_an_innovation_narrows_a_tube_and_is_said() -> None:
    model, funnel, proof = with_a_direct_part()
    plain = claim("linear")[1]["tubes"][0]
    assert tubes(funnel)["half_widths"][0] < plain["half_widths"][0]
    said = decide(model, funnel, proof)
    assert oracle.is_proved(model, funnel, proof)
    assert "; the innovation of speed at most 0.02 m/s in size at every sample" in str(said)
    assert "inferred share speed 0." in said.statement
    assert "nearly what was measured" not in said.statement
    assert "nearly what was measured" in decide(*with_a_direct_part(1.0, 10.0)).statement


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: tubes(f).update(direct=[0.55]), "not_definite"),
        (lambda f: tubes(f).update(direct=[0.7]), "not_below"),
        (lambda f: tubes(f)["peak"].update(at_most=[0.022]), "not_below"),
        (lambda f: tubes(f)["peak"].update(at_most=[10.0]), "not_below"),
        (lambda f: tubes(f)["peak"].update(at_most=[-0.02]), "not_below"),
        (lambda f: tubes(f).update(direct=[-0.1]), "not_below"),
        (lambda f: tubes(f).update(direct=[1.01], half_widths=[1e3]), "not_below"),
        (lambda f: tubes(f).update(direct=[0.6, 0.6]), "malformed"),
        (lambda f: tubes(f).pop("peak"), "malformed"),
        (lambda f: tubes(f)["peak"].update(level=1.0), "malformed"),
        (
            lambda f: tubes(f).update(follows=claim("following")[1]["tubes"][0]["follows"]),
            "malformed",
        ),
        (lambda f: tubes(f).pop("direct"), "not_definite"),
    ],
)
def test_a_forged_direct_part_is_refused(change: Callable[[Json], Any], reason: str) -> None:
    model, funnel, proof = with_a_direct_part()
    change(funnel)
    with refused(reason):
        decide(model, funnel, proof)
    about = {MODEL: model, FUNNEL: funnel}
    bindings = {"model": proofs.binding(MODEL, model), "funnel": proofs.binding(FUNNEL, funnel)}
    document = proofs.proof_document({"kind": "tube", "about": bindings}, proof)
    assert not oracle.agrees(document, about)


def term(funnel: Json, i: int = 0) -> Json:
    return tubes(funnel)["follows"]["terms"][i]  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: tubes(f)["follows"]["weights"][0].__setitem__(0, -1e-9), "not_below"),
        (
            lambda f: tubes(f)["follows"].update(
                weights=[[0.0] * len(tubes(f)["follows"]["terms"])]
            ),
            "not_below",
        ),
        (lambda f: tubes(f)["follows"].update(weights=[]), "malformed"),
        (lambda f: tubes(f)["follows"].update(terms=[]), "malformed"),
        (lambda f: term(f).update(fading=1.0), "not_below"),
        (lambda f: term(f).update(fading=-0.1), "not_below"),
        (lambda f: term(f).update(scale=0.0), "not_below"),
        (lambda f: term(f).update(inputs=[1]), "malformed"),
        (lambda f: term(f).update(inputs=[-1]), "malformed"),
        (lambda f: term(f).update(of="square"), "malformed"),
        (lambda f: term(f).update(future=1), "malformed"),
        (lambda f: tubes(f).update(inlet=1e-12), "malformed"),
    ],
)
def test_a_level_by_commands_that_makes_no_sense_is_refused(
    change: Callable[[Json], Any], reason: str
) -> None:
    model, funnel, proof = claim("following")
    change(funnel)
    assert not oracle.agrees(
        proofs.proof_document(
            {
                "kind": "tube",
                "about": {
                    "model": proofs.binding(MODEL, model),
                    "funnel": proofs.binding(FUNNEL, funnel),
                },
            },
            proof,
        ),
        {MODEL: model, FUNNEL: funnel},
    )
    with refused(reason):
        decide(model, funnel, proof)


OTHER_MODELS: dict[str, tuple[str, Change]] = {
    "slower": ("lasting_linear", lambda c: scaled(c.model, "a", 1.05)),
    "wider range of inputs": ("peak_moving_lags", lambda c: scaled(c.model, "u_range", 4.0)),
    "another unit": ("lasting_two_outputs", lambda c: scaled(c.model, "y_scale", 2.0)),
    "steeper map": ("lasting_cascade", lambda c: scaled(c.model["f"], "coefficients", 50.0)),
    "second filter": ("lasting_cascade", lambda c: scaled(c.model, "b2", 1.3)),
    "flatter left side": ("lasting_monotone", lambda c: scaled(c.model, "e", 0.7)),
    "implicit left side": (
        "lasting_implicit_ray",
        lambda c: scaled(c.model["h"]["coefficients"], 0, 0.5),
    ),
    "wider box": ("lasting_implicit_box", lambda c: scaled(c.funnel["box"], "u", 20.0)),
}


@pytest.mark.parametrize("what", OTHER_MODELS)
def test_another_model_with_right_digests_is_refused(what: str) -> None:
    name, change = OTHER_MODELS[what]
    model, funnel, proof = made_before(name)
    change(SimpleNamespace(model=model, funnel=funnel, proof=proof))
    if what == "wider box":  # a stiffer spring is still proved: the box goes where it is unstable
        for row, e in zip(model["h"]["coefficients"], model["h"]["exponents"], strict=True):
            if e[0] == 1 and e[2] == 2:
                row[0] = -row[0]
    assert not oracle.is_proved(model, funnel, proof)
    with pytest.raises(CertificateRejected):
        decide(model, funnel, proof)


@pytest.mark.parametrize(
    ("name", "change", "reason"),
    [
        ("peak_linear", lambda c: c.funnel.update(tubes=[]), "malformed"),
        ("peak_linear", lambda c: c.funnel.update(box={"y": [], "u": []}), "malformed"),
        ("peak_linear", lambda c: c.funnel.update(settling=-1), "malformed"),
        ("peak_linear", lambda c: c.proof.update(multipliers=[{"N": []}] * 2), "malformed"),
        ("peak_linear", lambda c: tubes(c.funnel).update(rho=1.0), "not_below"),
        ("peak_linear", lambda c: tubes(c.funnel).update(rho=0.0), "not_below"),
        ("peak_linear", lambda c: c.funnel["tubes"][1].update(rho=0.5), "not_below"),
        ("peak_linear", lambda c: first_assumption(c.funnel).update(kind="peak"), "malformed"),
        ("peak_linear", lambda c: first_assumption(c.funnel).update(samples=9), "malformed"),
        ("peak_linear", lambda c: tubes(c.funnel).update(inlet=-1e-9), "not_below"),
        ("peak_linear", lambda c: tubes(c.funnel).update(tau=[-1.0]), "not_below"),
        ("peak_linear", lambda c: scaled(tubes(c.funnel), "P", -1.0), "not_definite"),
        ("peak_linear", lambda c: tubes(c.funnel).update(R=[[-1.0]]), "not_definite"),
        (
            "lasting_monotone",
            lambda c: c.proof["multipliers"][0]["N"][0][1].__setitem__(0, 1e-9),
            "not_below",
        ),
        ("lasting_monotone", lambda c: c.proof["multipliers"][0]["N"].pop(), "malformed"),
        ("lasting_monotone", lambda c: c.proof["multipliers"].pop(), "malformed"),
        (
            "lasting_implicit_ray",
            lambda c: c.funnel.update(box={"y": [[-1.0, 1.0]], "u": [[-1.0, 1.0]]}),
            "not_valid",
        ),
        ("lasting_implicit_box", lambda c: c.funnel.pop("box"), "not_valid"),
        ("lasting_implicit_box", lambda c: c.funnel["box"].update(u=[[1.0, 1.0]]), "not_valid"),
        ("lasting_implicit_box", lambda c: c.model.pop("window"), "malformed"),
    ],
)
def test_what_is_no_tube_is_refused_with_the_reason(name: str, change: Change, reason: str) -> None:
    model, funnel, proof = made_before(name)
    change(SimpleNamespace(model=model, funnel=funnel, proof=proof))
    with refused(reason):
        decide(model, funnel, proof)


def test_a_funnel_made_for_another_model_is_refused() -> None:
    model, funnel, proof = claim("linear")
    funnel["model"] = "sha256:" + 64 * "0"
    about = {MODEL: model, FUNNEL: funnel}
    bindings = {"model": proofs.binding(MODEL, model), "funnel": proofs.binding(FUNNEL, funnel)}
    with refused("mismatch"):
        proofs.decide(proofs.proof_document({"kind": "tube", "about": bindings}, proof), about)
    assert files.digest(model) != funnel["model"]


# -- brute force -----------------------------------------------------------------------------


@EVERY
@pytest.mark.parametrize("kind", ["random", "sign", "held"])
def test_no_innovation_that_keeps_the_assumption_leaves_the_tube(name: str, kind: str) -> None:
    made = design(name)
    for i, tube in enumerate(made.funnel.tubes):
        used = attacks(made, i, kind, samples=600, seed=i)
        assert used.max() <= 1.0 + 1e-9
        assert np.sqrt(tube.level / tube.tau).max() <= tube.half_widths.max()


@pytest.mark.slow
@EVERY
def test_no_innovation_of_a_hundred_thousand_leaves_the_tube(name: str) -> None:
    made = design(name)
    most = 0.0
    for kind in ("random", "sign", "held"):
        most = max(most, float(attacks(made, 0, kind, samples=34_000, seed=7).max()))
    print(f"{name}: largest |o|/width {most:.3f}")
    assert 0.3 < most <= 1.0 + 1e-9


def test_the_tube_is_reached_so_the_attack_is_no_weak_one() -> None:
    most = max(attacks(design("linear"), 0, kind, 4000, 3).max() for kind in ("sign", "held"))
    assert most > 0.6
