"""The claim `tube` on a designed tube: the sentence, and what is refused and why."""

import json
import random
from decimal import Context, Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from bags.designs.documents import FUNNEL, FUNNEL_PROOF, MODEL, POLICY
from nlsid_core import files, proofs
from nlsid_core.arrays import Json
from nlsid_core.design import TubeDesign
from nlsid_core.errors import CertificateMismatch, CertificateRejected
from tests.core.kernel import oracle_driven_tube as oracle

NAMES = {"model": MODEL, "policy": POLICY, "funnel": FUNNEL}


@pytest.fixture
def documents(design: TubeDesign) -> dict[str, Json]:
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


def decide(documents: dict[str, Json], slack: object = 5e-6) -> proofs.Verdict:
    """The verdict on documents as they are, with a proof that names their digests."""
    about = {role: proofs.binding(NAMES[role], document) for role, document in documents.items()}
    proof = proofs.proof_document({"kind": "tube", "about": about}, {"slack": slack})
    return proofs.decide(proof, {NAMES[role]: documents[role] for role in NAMES})


def assuming(funnel: Json, **changes: object) -> Json:
    return funnel | {"assumption": funnel["assumption"] | changes}


def test_the_sentence_and_the_assumptions_are_these(documents: dict[str, Json]) -> None:
    funnel = documents["funnel"]
    samples = funnel["assumption"]["samples"]
    low, high = documents["model"]["u_range"]
    verdict = decide(documents)
    # Rounded outward to four digits from the numbers in the files.
    span = down((samples - 1) * documents["model"]["period"])
    width = up(funnel["half_widths"][0])
    assert verdict.statement == (
        f"tube: speed stays within {width} m/s of every trajectory of the model that starts as "
        f"assumed, the policy's nominal among them, for {samples} samples, which span {span} s, "
        "whether the trajectory's inputs are played, the policy is engaged around it, or anything "
        "between the two acts, such as the policy's input clipped to a range that holds the "
        f"trajectory's, as [{exactly(low)}, {exactly(high)}] m/s holds the nominal's"
    )
    assumption = funnel["assumption"]
    assert verdict.assumptions == (
        f"the observer starts with V = xbar'P xbar <= {down(funnel['inlet'])} (m/s)^2, xbar its "
        "state minus the trajectory's",
        f"innovation energy: sum of e^2 <= {down(assumption['budget'])} (m/s)^2 over {samples} "
        f"samples (largest of {len(assumption['measured_on'])} distinct trials, each taken whole, "
        f"{up(assumption['measured'])}, safety factor 1.5 in amplitude; no probability is "
        "stated of a next trial, as the model was fitted to 3 of them)",
    )
    assert verdict.margin == 5e-6


def exactly(value: float) -> str:
    return repr(value).removesuffix(".0")


def up(value: float) -> str:
    """Four significant digits, upward, by the decimal module."""
    return rounded(value, "ROUND_CEILING")


def down(value: float) -> str:
    return rounded(value, "ROUND_FLOOR")


def rounded(value: float, mode: str) -> str:
    number = Context(prec=4, rounding=mode).create_decimal(Decimal(value)).normalize()
    return f"{number:f}"


def test_a_start_at_the_nominal_and_played_inputs_are_said_in_those_words(
    documents: dict[str, Json],
) -> None:
    documents["funnel"]["inlet"] = 0
    documents["policy"]["K"] = [[0.0, 0.0]]
    verdict = decide(bound(documents))
    assert verdict.assumptions[0] == "the observer starts at the trajectory's state"
    assert verdict.statement.endswith("with the trajectory's inputs played (no feedback)")


@pytest.mark.parametrize("engaged", [0, 1])
def test_the_half_width_bounds_the_output_in_the_tube(design: TubeDesign, engaged: int) -> None:
    model, funnel, rng = design.model, design.funnel, np.random.default_rng(0)
    c = model.C[0] - engaged * model.D * design.policy.K
    root = np.linalg.cholesky(np.linalg.inv(funnel.P))
    direction = rng.standard_normal((20_000, len(model) + 1))
    direction *= np.sqrt(funnel.level) / np.linalg.norm(direction, axis=1, keepdims=True)
    outputs = direction[:, :-1] @ root.T @ c + direction[:, -1]
    assert np.abs(outputs).max() <= funnel.half_width


def test_repeated_trials_count_once_and_no_trial_measures_nothing(
    documents: dict[str, Json],
) -> None:
    once = documents["funnel"]["assumption"]["measured_on"][0]
    again = {"name": "the same under another name", "digest": once["digest"]}
    documents["funnel"] = assuming(documents["funnel"], measured_on=[once, again, once])
    assert "largest of 1 distinct trial, taken whole, " in decide(documents).assumptions[1]
    documents["funnel"] = assuming(documents["funnel"], measured_on=[])
    with pytest.raises(CertificateRejected, match="measured on no trial"):
        decide(documents)


def trials(*digests: str) -> list[Json]:
    return [{"name": f"trial {i}", "digest": digest} for i, digest in enumerate(digests)]


def fitted_to(documents: dict[str, Json], *digests: str) -> dict[str, Json]:
    return bound(documents | {"model": documents["model"] | {"bags": trials(*digests)}})


@pytest.mark.parametrize(
    ("measured_on", "fitted", "said"),
    [
        (("a", "b", "c"), ("d",), "exceeds their largest with probability at most 1/4)"),
        (("a", "a", "b", "b"), ("d",), "exceeds their largest with probability at most 1/3)"),
        (("a", "b", "c"), ("b", "a", "d", "b"), "as the model was fitted to 2 of them)"),
        (("a", "b"), ("b[3:4]",), "as the model was fitted to 1 of them)"),
        (("a[0:9]", "b"), (), "as windows of one recording are hardly exchangeable)"),
    ],
)
def test_a_probability_is_stated_only_of_trials_that_made_nothing(
    documents: dict[str, Json], measured_on: tuple[str, ...], fitted: tuple[str, ...], said: str
) -> None:
    changed = assuming(
        documents["funnel"], measured_on=trials(*measured_on), designed_on=trials("e", "a[9:10]")
        if measured_on[0] == "a[0:9]" else trials("e"),
    )  # fmt: skip
    verdict = decide(fitted_to(documents | {"funnel": changed}, *fitted))
    assert verdict.assumptions[1].endswith(said)


@pytest.mark.parametrize(
    ("measured_on", "designed_on", "allowed"),
    [
        (("a", "b"), ("c", "d"), True),
        (("a", "b"), ("c", "b"), False),
        (("a",), ("a[5:6]",), False),
        (("a[5:6]",), ("b", "a"), False),
        (("a[0:10]",), ("a[10:20]", "a[30:31]"), True),
        (("a[10:20]",), ("a[0:11]", "a[2:3]"), False),
        (("a[10:20]",), ("a[0:30]", "a[1:2]", "a[3:5]"), False),
        (("a[10:20]", "a[40:50]"), ("a[49:60]",), False),
    ],
)
def test_no_sample_designs_a_tube_and_scales_it(
    documents: dict[str, Json],
    measured_on: tuple[str, ...],
    designed_on: tuple[str, ...],
    allowed: bool,
) -> None:
    changed = assuming(
        documents["funnel"], measured_on=trials(*measured_on), designed_on=trials(*designed_on)
    )
    documents["funnel"] = changed
    assert oracle.is_proved(documents, 5e-6) is allowed
    if allowed:
        decide(documents)
    else:
        with pytest.raises(CertificateRejected, match="also designed the tube"):
            decide(documents)


@pytest.mark.parametrize("window", ["[", "[]", "[1:1]", "[2:1]", "[-1:2]", "[0:1", "[0:1]x",
                                    "[0:9999999999999]", "[0:1000000000000]x",
                                    "[٠:١]"])  # fmt: skip
def test_a_window_that_is_none_is_rejected(documents: dict[str, Json], window: str) -> None:
    documents["funnel"] = assuming(documents["funnel"], measured_on=trials("a" + window))
    with pytest.raises(CertificateRejected, match="a window should be"):
        decide(documents)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda f: f | {"level": f["level"] * 0.999}, "is below inlet"),
        (lambda f: f | {"inlet": f["inlet"] * 1.01}, "is below inlet"),
        (lambda f: f | {"inlet": -1.0}, "0 or more"),
        (lambda f: f | {"level": -1.0}, "is below inlet|half-width"),
        (lambda f: f | {"P": (1.01 * np.array(f["P"])).tolist()}, "the decrease of V"),
        (lambda f: f | {"P": (-np.array(f["P"])).tolist()}, "P is not positive definite"),
        (lambda f: f | {"P": [[1.0, 2.0], [0.0, 1.0]]}, "not symmetric"),
        (lambda f: f | {"P": [[1.0]]}, "should have shape"),
        (lambda f: f | {"R": [[0.999]]}, "the decrease of V"),
        (lambda f: f | {"R": [[-1.0]]}, "R is not positive definite"),
        (lambda f: f | {"tau": [f["tau"][0] * 1.001]}, "the bound on speed"),
        (lambda f: f | {"tau": [-f["tau"][0]]}, "tau should be positive"),
        (lambda f: f | {"tau": f["tau"] * 2}, "should have shape"),
        (lambda f: f | {"half_widths": [0.98 * f["half_widths"][0]]}, "half-width"),
        (lambda f: f | {"half_widths": [-f["half_widths"][0]]}, "should be positive"),
        (lambda f: f | {"rho": 0.99}, "rho should be 1"),
        (lambda f: assuming(f | {"rho": 0.5}, kind="fading"), "the decrease of V"),
        (lambda f: assuming(f | {"rho": 1.5}, kind="fading"), "rho should be 1"),
        (lambda f: assuming(f | {"rho": -0.5}, kind="fading"), "rho should be 1|the decrease"),
        (lambda f: assuming(f, kind="fading"), "rho should be 1"),
        (lambda f: assuming(f, budget=1e-9), "below safety_factor"),
        (lambda f: assuming(f, budget=f["assumption"]["budget"] * 1.001), "is below inlet"),
        (lambda f: assuming(f, safety_factor=0.99), "safety factor 1 or more"),
        (lambda f: assuming(f, samples=10**6), "the nominal"),
        (lambda f: assuming(f, samples=0), "whole number from 1"),
        (lambda f: assuming(f, samples=2.5), "whole number"),
        (lambda f: assuming(f, kind="peak"), "known: energy, fading"),
        (lambda f: f | {"note": 1}, "unknown member 'note'"),
        (lambda f: f | {"kind": "sampled"}, "expected 'linear'"),
        (lambda f: f | {"level": 2**53 + 2}, "whole number beyond"),
    ],
)  # fmt: skip
def test_a_forged_funnel_with_right_digests_is_rejected(
    documents: dict[str, Json], change: object, reason: str
) -> None:
    assert callable(change)
    documents["funnel"] = change(documents["funnel"])
    with pytest.raises(CertificateRejected, match=reason):
        decide(documents)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda p: p | {"K": (3.0 * np.array(p["K"])).tolist()}, "the decrease of V .*engaged"),
        (lambda p: p | {"L": (3.0 * np.array(p["L"])).tolist()}, "the decrease of V"),
        (lambda p: p | {"period": 0.0500001}, "period is not the model's"),
        (lambda p: p | {"u": [[9.0], *p["u"][1:]]}, "outside the model's input range"),
        (lambda p: p | {"u": p["u"][1:]}, "should have shape|covers"),
        (lambda p: p | {"law": "u = 0"}, "unknown member 'law'"),
    ],
)  # fmt: skip
def test_another_policy_with_right_digests_is_rejected(
    documents: dict[str, Json], change: object, reason: str
) -> None:
    assert callable(change)
    documents["policy"] = change(documents["policy"])
    with pytest.raises(CertificateRejected, match=reason):
        decide(bound(documents))


def test_a_nominal_that_does_not_obey_the_model_is_rejected(documents: dict[str, Json]) -> None:
    documents["policy"]["x"][20][0] += 1e-6
    with pytest.raises(CertificateRejected, match="departure from the model"):
        decide(bound(documents))


def test_a_faster_robot_with_right_digests_is_rejected(documents: dict[str, Json]) -> None:
    documents["model"]["a"] = (1.02 * np.array(documents["model"]["a"])).tolist()
    with pytest.raises(CertificateRejected):
        decide(bound(documents))


@pytest.mark.parametrize("slack", [0.0, -1e-9, 1.0, 2e-5, "1e-6", True, None])
def test_a_slack_that_is_not_there_is_rejected(documents: dict[str, Json], slack: object) -> None:
    with pytest.raises(CertificateRejected):
        decide(documents, slack)


def test_a_funnel_made_for_another_policy_is_rejected(documents: dict[str, Json]) -> None:
    documents["policy"]["K"] = [[0.0, 0.0]]
    with pytest.raises(CertificateMismatch, match="funnel was made for another policy"):
        decide(documents)


@pytest.mark.parametrize("name", [MODEL, POLICY, FUNNEL, FUNNEL_PROOF])
def test_a_changed_digit_in_any_number_of_any_file_is_rejected(
    design_folder: Path, name: str
) -> None:
    original = (design_folder / name).read_text()
    digits = [i for i, c in enumerate(original) if c in "12345678"]
    for i in digits[:: max(1, len(digits) // 60)]:
        mutant = original[:i] + str(int(original[i]) + 1) + original[i + 1 :]
        (design_folder / name).write_text(mutant)
        if name == FUNNEL_PROOF and '"slack"' in original[:i]:
            continue  # the slack is not bound by a digest: another one may be true
        with pytest.raises(CertificateRejected):
            proofs.check(design_folder / FUNNEL_PROOF)


@pytest.mark.parametrize("name", [MODEL, POLICY, FUNNEL])
def test_a_missing_file_is_rejected_by_name(design_folder: Path, name: str) -> None:
    (design_folder / name).unlink()
    with pytest.raises(CertificateMismatch, match=name):
        proofs.check(design_folder / FUNNEL_PROOF)


# -- the oracle ------------------------------------------------------------------------------


def test_random_claims_are_decided_as_the_oracle_decides(design: TubeDesign) -> None:
    """Every number moved at random, a little or by its size: true and false claims."""
    rng, decided = random.Random(3), {True: 0, False: 0}
    for _ in range(150):
        documents = {role: copied(getattr(design, role).document()) for role in NAMES}
        size, slack = 10.0 ** rng.uniform(-10, -1), 5e-6
        place: list[object] = rng.choice(places(documents, rng))
        *path, last = place
        inner: object = documents
        for key in path:
            inner = inner[key]  # type: ignore[index]
        inner[last] *= 1 + size * rng.choice((-1, 1))  # type: ignore[index]
        if path[-2:-1] == ["P"]:
            documents["funnel"]["P"][last][path[-1]] = inner[last]  # type: ignore[index]
        documents = bound(documents)
        truth = oracle.is_proved(documents, slack)
        decided[truth] += 1
        if truth:
            decide(documents, slack)
        else:
            with pytest.raises(CertificateRejected):
                decide(documents, slack)
    assert min(decided.values()) > 20, decided


def places(documents: dict[str, Json], rng: random.Random) -> list[list[object]]:
    """Where the numbers are."""
    n, N = len(documents["model"]["a"]), len(documents["policy"]["u"])
    i, j, k = rng.randrange(n), rng.randrange(n), rng.randrange(N)
    return [
        ["model", "a", i], ["model", "b", rng.randrange(n + 1)], ["model", "c"],
        ["policy", "K", 0, i], ["policy", "L", i, 0], ["policy", "x", k, i], ["policy", "u", k, 0],
        ["funnel", "P", i, j], ["funnel", "R", 0, 0], ["funnel", "level"], ["funnel", "inlet"],
        ["funnel", "tau", 0], ["funnel", "half_widths", 0], ["funnel", "assumption", "budget"],
        ["funnel", "assumption", "measured"], ["funnel", "assumption", "safety_factor"],
    ]  # fmt: skip


def test_exact_runs_that_keep_the_assumption_stay_in_the_half_width(
    documents: dict[str, Json],
) -> None:
    rng, most = random.Random(0), Fraction(0)
    width = Fraction(documents["funnel"]["half_widths"][0])
    for _ in range(20):
        for output, _ in oracle.runs(documents, rng, 40):
            most = max(most, abs(output))
    assert width / 4 < most <= width


def test_the_smallest_tube_that_is_false_is_left(documents: dict[str, Json]) -> None:
    """At e along the worst direction the output is tau's bound: 1 % less is left, and refused."""
    funnel = documents["funnel"]
    P, level = np.array(funnel["P"]), Fraction(funnel["level"])
    _, output = oracle.closed(documents["model"], documents["policy"], Fraction(0))
    x = [Fraction(v) for v in np.linalg.solve(P, np.array(output, dtype=float))]
    scaled = oracle.V(oracle.rows(funnel["P"]), x) + 1  # the direction (x, e = 1)
    reached = sum((h * v for h, v in zip(output, x, strict=True)), Fraction(1)) ** 2 / scaled
    # o² = reached (V + e²) there, so a tau above 1/reached is false.
    false = float(1 / reached) * (1 + 1e-9)
    documents["funnel"]["tau"] = [false]
    assert Fraction(false) * reached > 1
    assert level > 0
    with pytest.raises(CertificateRejected, match="the bound on speed"):
        decide(documents)


def test_a_fading_tube_is_proved_and_says_so(documents: dict[str, Json]) -> None:
    """rho = 0.999 needs a larger R: the same P, by the oracle and by the kernel."""
    funnel = documents["funnel"]
    funnel |= {"rho": 0.9375, "R": [[64.0]], "tau": [1e-3 * funnel["tau"][0]], "half_widths": [9.0]}
    documents["funnel"] = assuming(funnel, kind="fading")
    documents["policy"]["K"] = [[0.0, 0.0]]
    documents["policy"]["L"] = [[0.01], [0.01]]
    documents = bound(documents)
    if not oracle.is_proved(documents, 5e-6):
        documents["funnel"]["P"] = np.linalg.inv(_gramian(documents["model"], 0.9375)).tolist()
        P = np.array(documents["funnel"]["P"])
        documents["funnel"]["P"] = ((P + P.T) / 2).tolist()
    documents = bound(documents)
    assert oracle.is_proved(documents, 5e-6)
    verdict = decide(documents)
    samples = documents["funnel"]["assumption"]["samples"]
    budget = down(documents["funnel"]["assumption"]["budget"])
    assert verdict.assumptions[1].startswith(
        f"innovation energy: E <= {budget} (m/s)^2 after each of {samples} samples, "
        "E+ = 0.9375 E + 64 e^2 from 0 (largest of "
    )
    for output, energy in oracle.runs(documents, random.Random(1), 60):
        assert energy <= Fraction(documents["funnel"]["assumption"]["budget"])
        assert abs(output) <= Fraction(documents["funnel"]["half_widths"][0])


def _gramian(model: Json, rho: float) -> np.ndarray:
    A = np.array(oracle.parts(model)[0], dtype=float) / np.sqrt(rho)
    W = np.eye(len(A))
    for _ in range(2000):
        W = A @ W @ A.T + np.eye(len(A))
    return W


def test_the_departure_of_the_nominal_costs_what_it_costs(documents: dict[str, Json]) -> None:
    """√level = √s + √q: the oracle's least level is proved, one just below it refused."""
    documents["policy"]["x"][5][0] += 1e-4
    documents["funnel"]["half_widths"] = [9.0]
    low, high = documents["funnel"]["level"], 100 * documents["funnel"]["level"]
    for _ in range(30):
        documents["funnel"]["level"] = (low + high) / 2
        if oracle.is_proved(bound(documents), 5e-6):
            high = documents["funnel"]["level"]
        else:
            low = documents["funnel"]["level"]
    documents["funnel"]["level"] = high
    decide(bound(documents))
    documents["funnel"]["level"] = low
    with pytest.raises(CertificateRejected, match="departure from the model"):
        decide(bound(documents))
