"""The claim `tube` about a policy: the sentence, and what is refused and why."""

import json
import random
from decimal import Context, Decimal
from fractions import Fraction

import numpy as np
import pytest

from bags.designs.documents import FUNNEL, MODEL, POLICY
from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.design import OutputTubeDesign
from nlsid_core.errors import CertificateRejected
from tests.core.kernel import oracle_tube as oracle
from tests.core.kernel.refusals import refused
from tests.core.kernel.tube_claims import claim

NAMES = {"model": MODEL, "policy": POLICY, "funnel": FUNNEL}


@pytest.fixture
def documents(design: OutputTubeDesign) -> dict[str, Json]:
    """The three documents by role."""
    return {role: copied(getattr(design, role).document()) for role in NAMES}


def copied(document: Json) -> Json:
    return json.loads(json.dumps(document))  # type: ignore[no-any-return]


def bound(documents: dict[str, Json]) -> dict[str, Json]:
    """The documents with every digest inside them made to fit again."""
    model, policy, funnel = (documents[role] for role in NAMES)
    policy = policy | {"model": files.digest(model)}
    funnel = funnel | {"model": files.digest(model), "policy": files.digest(policy)}
    return {"model": model, "policy": policy, "funnel": funnel}


def decide(documents: dict[str, Json]) -> proofs.Verdict:
    """The verdict on documents as they are, with a proof that names their digests."""
    about = {role: proofs.binding(NAMES[role], document) for role, document in documents.items()}
    proof = proofs.proof_document({"kind": "tube", "about": about}, {})
    return proofs.decide(proof, {NAMES[role]: documents[role] for role in NAMES})


def is_proved(documents: dict[str, Json]) -> bool:
    return oracle.is_proved(documents["model"], documents["funnel"], {}, documents["policy"])


def changing(funnel: Json, **changes: object) -> Json:
    """The funnel with its first tube changed."""
    return funnel | {"tubes": [funnel["tubes"][0] | changes, *funnel["tubes"][1:]]}


def assuming(funnel: Json, **changes: object) -> Json:
    return changing(funnel, assumption=funnel["tubes"][0]["assumption"] | changes)


def lasting(funnel: Json, samples: object) -> Json:
    """The funnel with the energy of its second tube over so many samples."""
    energy = funnel["tubes"][1]
    changed = energy | {"assumption": energy["assumption"] | {"samples": samples}}
    return funnel | {"tubes": [funnel["tubes"][0], changed]}


def first(funnel: Json) -> Json:
    return funnel["tubes"][0]  # type: ignore[no-any-return]


def test_the_sentence_and_the_assumptions_are_these(documents: dict[str, Json]) -> None:
    funnel, model, policy = (documents[key] for key in ("funnel", "model", "policy"))
    lasting, energy = funnel["tubes"]
    low, high = model["u_range"]
    verdict = decide(documents)
    # Rounded outward to four digits from the numbers in the files.
    span = down((len(policy["u"]) - 1) * model["period"])
    wide = [up(tube["half_widths"][0]) for tube in (lasting, energy)]
    assert verdict.statement == (
        f"tube: the measured speed stays within {wide[0]} m/s of what the model predicts from the "
        "inputs alone, for every input, for ever, as long as its assumptions hold (tube 1); "
        f"also within {wide[1]} m/s for 70 samples, which span {span} s (tube 2); and as near the "
        "policy's plan, which is the simulation from its start under its inputs, for at most its "
        f"70 samples, which span {span} s, whether those inputs are played, the policy is engaged "
        "around them, or "
        "anything between the two acts, such as the policy's input clipped to a range that holds "
        f"the plan's, as [{exactly(low)}, {exactly(high)}] m/s does"
    )
    inlets = " and ".join(down(tube["inlet"]) for tube in (lasting, energy))
    assert verdict.assumptions == (
        f"after 2 samples ({up(0.2)} s) the simulation starts at the observer's state, or where V "
        f"= xbar'P xbar <= {inlets}, xbar the observer's state minus its own, as the plan does",
        f"tube 1: innovation energy: E <= {down(lasting['level'])} (m/s)^2 after every sample, "
        f"E+ = {lasting['rho']} E + e^2 from 0",
        f"tube 2: innovation energy: sum of e^2 <= {down(energy['level'])} (m/s)^2 over 70 samples",
    )
    assert 0.0 < verdict.margin < 0.01


def exactly(value: float) -> str:
    return repr(value).removesuffix(".0")


def up(value: float) -> str:
    """Four significant digits, upward, by the decimal module."""
    return rounded(value, "ROUND_CEILING")


def down(value: float) -> str:
    return rounded(value, "ROUND_FLOOR")


def rounded(value: float, mode: str) -> str:
    own = Decimal(repr(value)).normalize()
    if len(own.as_tuple().digits) <= 6:
        return f"{own:f}"
    number = Context(prec=4, rounding=mode).create_decimal(Decimal(value)).normalize()
    return f"{number:f}"


def test_a_start_at_the_plans_and_played_inputs_are_said_in_those_words(
    documents: dict[str, Json],
) -> None:
    for tube in documents["funnel"]["tubes"]:
        tube["inlet"] = 0
    documents["policy"]["K"] = [[0.0, 0.0]]
    verdict = decide(bound(documents))
    assert verdict.assumptions[0].endswith(
        "the simulation starts at the observer's state, as the plan does"
    )
    assert verdict.statement.endswith("with those inputs played (no feedback)")


def trials(*digests: str) -> list[Json]:
    """Of recordings that are named by a letter, before a window if there is one."""
    return [
        {"name": f"trial {i}", "digest": f"sha256:{64 * digest[0]}{digest[1:]}"}
        for i, digest in enumerate(digests)
    ]


def fitted_to(documents: dict[str, Json], *digests: str) -> dict[str, Json]:
    return bound(documents | {"model": documents["model"] | {"bags": trials(*digests)}})


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: changing(f, level=first(f)["level"] * 1.03), "not_below"),
        (lambda f: changing(f, inlet=first(f)["inlet"] + 0.05 * first(f)["level"]), "not_below"),
        (lambda f: changing(f, inlet=-1.0), "not_below"),
        (lambda f: changing(f, level=-1.0), "not_below"),
        (lambda f: changing(f, P=(1.01 * np.array(first(f)["P"])).tolist()), "not_definite"),
        (lambda f: changing(f, P=(-np.array(first(f)["P"])).tolist()), "not_definite"),
        (lambda f: changing(f, P=[[1.0, 2.0], [0.0, 1.0]]), "not_definite"),
        (lambda f: changing(f, P=[[1.0]]), "malformed"),
        (lambda f: changing(f, R=[[0.97]]), "not_definite"),
        (lambda f: changing(f, R=[[-1.0]]), "not_definite"),
        (lambda f: changing(f, tau=[first(f)["tau"][0] * 1.003]), "not_definite"),
        (lambda f: changing(f, tau=[-first(f)["tau"][0]]), "not_below"),
        (lambda f: changing(f, tau=first(f)["tau"] * 2), "malformed"),
        (lambda f: changing(f, half_widths=[0.97 * first(f)["half_widths"][0]]), "not_below"),
        (lambda f: changing(f, half_widths=[-1.0]), "not_below"),
        (lambda f: changing(f, rho=0.95 * first(f)["rho"]), "not_definite"),
        (lambda f: changing(f, rho=1.5), "not_below"),
        (lambda f: changing(f, rho=-0.5), "not_below"),
        (lambda f: changing(f, rho=1), "not_below"),
        (lambda f: assuming(f, kind="energy"), "malformed"),
        (lambda f: assuming(f, kind="energy", samples=9), "not_below"),
        (lambda f: assuming(f, samples=9), "malformed"),
        (lambda f: lasting(f, 0), "malformed"),
        (lambda f: lasting(f, 2.5), "malformed"),
        (lambda f: assuming(f, kind="peak"), "malformed"),
        (lambda f: f | {"note": 1}, "malformed"),
        (lambda f: f | {"kind": "sampled"}, "malformed"),
        (lambda f: changing(f, level=2**53 + 2), "malformed"),
        (lambda f: changing(f, L=[[0.0], [0.0]]), "malformed"),
    ],
)
def test_a_forged_funnel_with_right_digests_is_rejected(
    documents: dict[str, Json], change: object, reason: str
) -> None:
    assert callable(change)
    documents["funnel"] = change(documents["funnel"])
    with refused(reason):
        decide(documents)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: p | {"K": (9.0 * np.array(p["K"])).tolist()}, "not_definite"),
        (lambda p: p | {"L": (3.0 * np.array(p["L"])).tolist()}, "malformed"),
        (lambda p: p | {"period": 0.0500001}, "malformed"),
        (lambda p: p | {"u": [[9.0], *p["u"][1:]]}, "not_valid"),
        (lambda p: p | {"u": []}, "too_large"),
        (lambda p: p | {"start": [0.0]}, "malformed"),
        (lambda p: p | {"law": "u = 0"}, "malformed"),
        (lambda p: p | {"kind": "linear"}, "malformed"),
    ],
)
def test_another_policy_with_right_digests_is_rejected(
    documents: dict[str, Json], change: object, reason: str
) -> None:
    assert callable(change)
    documents["policy"] = change(documents["policy"])
    with refused(reason):
        decide(bound(documents))


def test_a_plan_is_taken_up_to_the_limit_and_no_longer(
    documents: dict[str, Json], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit is moved to the plan: a million rows take 12 s to write and to read."""
    monkeypatch.setattr("nlsid_core.kernel.tube.MAX_PLAN", len(documents["policy"]["u"]))
    decide(documents)
    documents["policy"]["u"].append(documents["policy"]["u"][-1])
    with refused("too_large"):
        decide(bound(documents))


def test_a_plan_is_for_a_linear_model(documents: dict[str, Json]) -> None:
    model, funnel, proof = claim("monotone")
    del funnel["cusum"]  # these, and levels by commands, have no plan
    first(funnel).pop("follows", None)
    policy = documents["policy"] | {
        "period": model["period"],
        "start": [0.0] * len(model["a"]),
        "L": first(funnel)["L"],
        "K": [[0.0] * len(model["a"])],
    }
    found = bound({"model": model, "policy": policy, "funnel": funnel})
    about = {role: proofs.binding(NAMES[role], document) for role, document in found.items()}
    document = proofs.proof_document({"kind": "tube", "about": about}, proof)
    with refused("malformed"):
        proofs.decide(document, {NAMES[role]: found[role] for role in NAMES})


def test_a_faster_robot_with_right_digests_is_rejected(documents: dict[str, Json]) -> None:
    documents["model"]["a"] = (1.02 * np.array(documents["model"]["a"])).tolist()
    with pytest.raises(CertificateRejected):
        decide(bound(documents))


def test_a_funnel_made_for_another_policy_is_rejected(documents: dict[str, Json]) -> None:
    documents["policy"]["K"] = [[0.0, 0.0]]
    with refused("mismatch"):
        decide(documents)


# -- the oracle ------------------------------------------------------------------------------


def test_exact_runs_that_keep_the_assumption_stay_in_the_half_width(
    documents: dict[str, Json],
) -> None:
    rng = random.Random(0)
    for tube in documents["funnel"]["tubes"]:
        width, most = Fraction(tube["half_widths"][0]), Fraction(0)
        for _ in range(20):
            for output, E in oracle.runs(documents["model"], documents["policy"], tube, rng, 40):
                assert Fraction(tube["level"]) >= E
                most = max(most, abs(output))
        assert width / 4 < most <= width


def test_the_smallest_tube_that_is_false_is_refused(documents: dict[str, Json]) -> None:
    """At e along the worst direction the output is tau's bound: a larger tau is false."""
    tube = first(documents["funnel"])
    P, rho = np.array(tube["P"]), Fraction(tube["rho"])
    outputs = [
        oracle.closed(documents["model"], documents["policy"], Fraction(k))[1][0] for k in (0, 1)
    ]
    false = []
    for output in outputs:
        x = [Fraction(v) for v in np.linalg.solve(P, np.array(output, dtype=float)) / tube["rho"]]
        scaled = rho * oracle.V(oracle.matrix(tube["P"], 2, 2), x) + 1  # the direction (x, e = 1)
        reached = sum((h * v for h, v in zip(output, x, strict=True)), Fraction(1)) ** 2 / scaled
        # o² = reached (ρV + e²) there, so a tau above 1/reached is false.
        false.append(float(1 / reached) * (1 + 1e-9))
        assert Fraction(false[-1]) * reached > 1
    tube["tau"] = [min(false)]
    with refused("not_definite"):
        decide(documents)
