"""Claims of gains, passivity and small gain: oracle, sentence, true values, runs, forgeries."""

import random
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import CertificateRejected
from nlsid_core.models import CellNetwork, ImplicitModel, StateAffineModel
from nlsid_core.running.stepping import Stepper
from tests.core.kernel import oracle_dissipation as oracle
from tests.core.kernel.dissipation_claims import MODEL, MODELS, claim, decide, loop
from tests.marks import slow_among

SCHEMAS = Path(__file__).resolve().parents[3] / "docs" / "schema"
NAMES = list(MODELS)
GAINS = [name for name in NAMES if name not in ("passive", "short")]


@pytest.mark.parametrize("name", NAMES)
def test_the_oracle_agrees_and_no_bound_is_better_than_the_claim(name: str) -> None:
    model, proof = claim(name)
    verdict = decide(model, proof)
    assert oracle.agrees(proof, {MODEL: model})
    number = Fraction(proof["claim"]["supply"]["number"])
    words = verdict.statement.split()
    if name in GAINS:
        shown = words[words.index("G") + 2].rstrip(",")
        assert number <= Fraction(shown) <= number * Fraction(1002, 1000)
        assert verdict.margin == 1 / number
    else:
        shown = words[words.index(">=") + 1]
        assert number - abs(number) / 500 <= Fraction(shown) <= number
        assert verdict.margin == number


def test_the_sentences_are_these() -> None:
    model, proof = claim("linear")
    assert decide(model, proof).statement == (
        "incremental gain: two runs of the model satisfy sum |dy|^2 <= G^2 sum |du|^2 + V(0) up to "
        "every sample t >= 0, G = 1.126, dy the difference of speed in units of 1 m/s, du that of "
        "command in units of 1 V, V(0) = x'Px of the difference of their states, 0 where both have "
        "one past, for every input"
    )
    model, proof = claim("integrator")
    assert "sum 0.875^k |dy|^2 <= G^2 sum 0.875^k |du|^2 + V(0)" in decide(model, proof).statement
    model, proof = claim("passive")
    said = decide(model, proof).statement
    assert said.startswith(
        "incremental passivity: two runs of the model satisfy sum du'dy >= 0.6665 sum |du|^2 - "
        "V(0)/2 up to every sample t >= 0, "
    )
    proof["claim"]["supply"]["number"] = 0.0
    assert " sum du'dy >= -V(0)/2 up to every sample " in decide(model, proof).statement
    model, proof = claim("short")
    assert decide(model, proof).statement.startswith(
        "limited shortage of incremental passivity: two runs of the model satisfy sum du'dy >= "
        "-0.233 sum |du|^2 - V(0)/2 up to every sample t >= 0, "
    )
    model, proof = claim("constant")
    said = decide(model, proof).statement
    assert "the difference of y0 in units of 2 m/s and y1 in units of 0.25 m/s, du that" in said
    assert said.endswith("for every input (the model clips its inputs: command in [-1, 2] V)")
    model, proof = claim("implicit_box")
    verdict = decide(model, proof)
    assert verdict.statement.endswith(", while signals stay in the box")
    assert verdict.assumptions == (
        "from their past on, both runs stay in y0 in [-1.5, 1.5] m, u in [-1, 1.5] N",
    )
    model, proof = claim("moving")
    assert decide(model, proof).assumptions == (
        "from their past on, both runs stay in y0 in [-1, 1] m/s",
    )


def response(model: Any, discount: float) -> FloatArray:
    """Of y = Σ a y(t-k) + Σ b u(t-k), at z = e^{jw}/√λ, by its definition."""
    z = np.exp(1j * np.linspace(0.0, np.pi, 20_001)) / np.sqrt(discount)
    above = sum(b * z**-k for k, b in enumerate(model.b))
    below = 1.0 - sum(a * z ** -(k + 1) for k, a in enumerate(model.a))
    return np.asarray(above / below)


@pytest.mark.parametrize("name", ["linear", "passive", "short", "integrator"])
def test_what_is_proved_of_a_linear_model_is_its_frequency_response(name: str) -> None:
    _, proof = claim(name)
    G = response(MODELS[name](), proof["claim"]["discount"])
    proved = proof["claim"]["supply"]["number"]
    if name in GAINS:
        assert 0.0 <= proved - np.abs(G).max() < 1e-3 * proved
    else:
        assert 0.0 <= G.real.min() - proved < 1e-3 * abs(proved)


def runs(name: str, rng: np.random.Generator, samples: int = 60) -> tuple[FloatArray, FloatArray]:
    """ū and ȳ of two runs of the model itself from one past, stepped by what runs beside a robot.

    Inputs are steps and noise; the difference is a wave, a pulse or noise, small or large.
    """
    model = MODELS[name]()
    low, high = -1.0, 1.5
    if isinstance(model, StateAffineModel):
        low, high = -1.0, 2.0
    steppers = [Stepper(model) for _ in range(2)]
    q, p = len(steppers[0].u), len(steppers[0].y)
    base = rng.uniform(low, high, (samples, q))
    if rng.random() < 0.5:
        base = np.repeat(base[::10], 10, axis=0)
    shape = rng.choice(3)
    wave = np.cos(rng.uniform(0.0, np.pi) * np.arange(samples))
    delta = [wave, np.arange(samples) == 3, rng.normal(size=samples)][shape][:, None]
    other = base + 10.0 ** rng.uniform(-2, 0.5) * delta * rng.normal(size=q)
    if name == "implicit_box":  # whose signals stay in the box
        base, other = (np.clip(0.1 * u, -1.0, 1.5) for u in (base, other))
    lags = max(steppers[0].lags, 1)
    found = []
    for stepper, u in zip(steppers, (base, other), strict=True):
        past = np.zeros((lags, q))
        x, y = stepper.begin(np.zeros((lags, p)), past)[None], np.zeros((samples, p))
        for t in range(samples):
            after, x = stepper.advance(x, u[t])
            y[t] = after[0]
        found.append(y)
    return other - base, found[1] - found[0]


@pytest.mark.parametrize("name", slow_among(NAMES, {"network", "cascade"}))
def test_no_two_runs_of_the_model_itself_differ_by_more(name: str) -> None:
    rng, (_, proof) = np.random.default_rng(5), claim(name)
    stated, model = proof["claim"], MODELS[name]()
    number, most = stated["supply"]["number"], 0.0
    for _ in range(60):
        u, y = runs(name, rng)
        fade = (stated["discount"] ** np.arange(len(u)))[:, None]
        u, y = u / stated["scales"]["u"], y / stated["scales"]["y"]
        energy = (fade * u**2).sum(axis=1).cumsum()
        if name in GAINS:
            used = (fade * y**2).sum(axis=1).cumsum() - number**2 * energy
            most = max(most, float(np.sqrt((fade * y**2).sum() / max(energy[-1], 1e-30))))
        else:
            used = number * energy - (fade * u * y).sum(axis=1).cumsum()
        assert used.max() <= 1e-9 * max(1.0, energy[-1])
    if name in GAINS and not isinstance(model, CellNetwork | ImplicitModel):
        assert most > 0.2 * number  # the runs are not all harmless


@pytest.mark.parametrize("name", slow_among(NAMES, {"network", "cascade"}))
def test_random_claims_are_decided_as_the_oracle_decides(name: str) -> None:
    """Every number moved at random, a little or by its size: true and false claims."""
    rng = random.Random(name)
    decided = {True: 0, False: 0}
    for _ in range(30):
        model, proof = claim(name)
        size = 10.0 ** rng.uniform(-6, 0.5) * rng.choice((-1, 1))
        what = rng.choice(("number", "P", "N", "model", "scales", "discount", "box"))
        if what == "number":
            proof["claim"]["supply"]["number"] *= 1 + size
        elif what == "discount":
            proof["claim"]["discount"] = min(1.0, proof["claim"]["discount"] * (1 + size))
        elif what == "scales":
            proof["claim"]["scales"][rng.choice("uy")][0] *= 1 + size
        elif what == "box" and "box" in proof["claim"]:
            proof["claim"]["box"]["y"][0][1] *= 1 + size
        elif what == "N" and "multipliers" in proof["proof"]:
            tree = proof["proof"]["multipliers"]
            while "parts" in tree:
                tree = rng.choice(tree["parts"])
            move(tree["N"], size, rng)
        elif what == "P":
            move(proof["proof"]["P"], size, rng, symmetric=True)
        else:
            move(rng.choice(numbers_of(model)), size, rng)
        truth = oracle.agrees(proof, {MODEL: model})
        decided[truth] += 1
        if truth:
            decide(model, proof)
        else:
            with pytest.raises(CertificateRejected):
                decide(model, proof)
    assert min(decided.values()) >= 3, decided


def numbers_of(model: Json) -> list[list[list[float]]]:
    """Tables of numbers of a model that a claim rests on."""
    kind = model["kind"]
    if kind == "difference_equation":
        return [[model["a"]], [model["b"]]]
    if kind == "block_cascade":
        return [model["b1"], model["b2"], [model["a1"]], [model["f"]["coefficients"]]]
    if kind == "cell_network":
        return [model["next"], model["into"], model["output"], [f["values"] for f in model["maps"]]]
    if kind == "monotone_equation":
        return [[model["e"]], [model["a"]], [model["b"]]]
    if kind == "implicit":
        return [model["h"]["coefficients"]]
    G = [[row for block in g["coefficients"] for row in block] for g in model["G"]]
    scales = [[model["u_scale"]], [model["y_scale"]]]
    return [model["p"]["coefficients"], *scales, model["u_range"], *G]


def move(
    rows: list[list[float]], size: float, rng: random.Random, *, symmetric: bool = False
) -> None:
    i = rng.randrange(len(rows))
    j = rng.randrange(len(rows[i]))
    rows[i][j] *= 1 + size
    if symmetric:
        rows[j][i] = rows[i][j]


def put(part: str, *path: Any) -> Callable[[Json, Json], None]:
    """Sets the last of `path` at the ones before it, in the model, the claim or the proof."""

    def change(model: Json, document: Json) -> None:
        at: Any = {"model": model, "claim": document["claim"], "proof": document["proof"]}[part]
        for key in path[:-2]:
            at = at[key]
        at[path[-2]] = path[-1]

    return change


FORGERIES = [
    ("linear", put("claim", "supply", "number", 1.1256), "growth"),
    ("linear", put("claim", "supply", "number", -1.2), "should be positive"),
    ("linear", put("claim", "supply", "number", 0), "should be positive"),
    ("linear", put("claim", "supply", "kind", "energy"), "is unknown"),
    ("linear", put("claim", "supply", "kind", "passivity"), "growth"),
    ("linear", put("claim", "discount", 1.0000001), "discount"),
    ("linear", put("claim", "discount", 0.0), "discount"),
    ("linear", put("claim", "scales", "u", [2.0]), "growth"),
    ("linear", put("claim", "scales", "y", [0.5]), "growth"),
    ("linear", put("claim", "scales", "y", [-1.0]), "scales should be positive"),
    ("linear", put("claim", "scales", "y", [1.0, 1.0]), "shape"),
    ("linear", put("claim", "box", {"y": [[-1.0, 1.0]]}), "needs no box"),
    ("linear", put("proof", "multipliers", {"N": [[]]}), "no multipliers"),
    ("linear", put("model", "b", [0.2, 0.1, 0.0, -0.31]), "growth"),
    ("linear", put("proof", "P", [[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]]), "P is not"),
    ("integrator", put("claim", "discount", 1.0), "growth"),
    ("passive", put("claim", "supply", "number", 0.6667), "growth"),
    ("short", put("claim", "supply", "number", 0.0), "growth"),
    ("cascade", put("model", "f", "spacing", 0.1), "growth"),
    ("monotone", put("proof", "multipliers", {"N": [[-1.0]] + [[0.0]] * 3}), "unbounded slope"),
    ("monotone", put("proof", "multipliers", {"N": [[1.0], [0.0], [0.0], [0.1]]}), "unbounded"),
    ("constant", put("claim", "supply", "kind", "passivity"), "as many inputs"),
    ("curved", put("claim", "supply", "kind", "passivity"), "does not clip"),
    ("curved", put("claim", "box", {"y": [[-1.0, 1.0]]}), "none elsewhere"),
    ("curved", put("model", "u_range", [[-1.0, 4.0]]), "growth"),
    ("moving", put("claim", "box", {"y": [[-1.0, 4.0]]}), "growth"),
    ("moving", put("claim", "box", {"y": [[1.0, -1.0]]}), "empty"),
    ("moving", put("claim", "box", {"y": [[-1.0, 1.0]], "u": [[-1.0, 1.0]]}), "u"),
    ("implicit_box", put("claim", "box", "u", [[-1.0, 1.0], [0, 1]]), "shape"),
    ("implicit_box", put("claim", "box", "y", [[-3.0, 3.0]]), "growth"),
    ("implicit_linear", put("claim", "box", {"y": [[-3.0, 3.0]] * 2, "u": [[0, 1]]}), "no box"),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(FORGERIES)))
def test_a_forgery_is_refused_and_no_oracle_proves_it(number: int) -> None:
    name, change, reason = FORGERIES[number]
    model, proof = claim(name)
    change(model, proof)
    with pytest.raises(CertificateRejected, match=reason):
        decide(model, proof)
    assert not oracle.agrees(proof, {MODEL: model})


@pytest.mark.parametrize("name", ["moving", "implicit_box"])
def test_a_box_cannot_be_left_out(name: str) -> None:
    model, proof = claim(name)
    del proof["claim"]["box"]
    with pytest.raises(CertificateRejected, match="box"):
        decide(model, proof)
    assert not oracle.agrees(proof, {MODEL: model})


def test_a_state_that_is_no_past_output_is_refused_on_a_box() -> None:
    """The box says where outputs are: x2 = 10 u(t-1) may be elsewhere."""
    model, proof = claim("implicit_box")
    model["states"] = ["x1", "x2"]
    model["h"] = {"exponents": [[1, 0, 0, 0], [0, 0, 3, 0]], "coefficients": [[1.0], [-0.001]]}
    model["shift"] = {"exponents": [[0, 0, 1]], "coefficients": [[10.0]]}
    for box, refused in ((proof["claim"]["box"], "past outputs"), (None, "on a box only")):
        proof["claim"] = proof["claim"] | {"box": box}
        if box is None:
            del proof["claim"]["box"]
        with pytest.raises(CertificateRejected, match=refused):
            decide(model, proof)


@pytest.mark.parametrize("name", ["monotone", "implicit_linear"])
@pytest.mark.parametrize("delay", [119, 2**53])
def test_inputs_that_are_remembered_for_too_long_are_refused_at_once(name: str, delay: int) -> None:
    model, proof = claim(name)
    model["window"][0][1] = delay
    with pytest.raises(CertificateRejected, match="remembered inputs; 1 to 120 together"):
        decide(model, proof)


@pytest.mark.slow
def test_a_model_of_too_many_terms_is_refused_before_they_are_written_out() -> None:
    model, proof = claim("moving")
    terms = [[i, j] for i in range(20) for j in range(20)]
    for k in range(119):
        exponents = {"exponents": terms, "coefficients": [[[0.0]]] * len(terms)}
        model["G"].insert(1 + k, exponents)
    with pytest.raises(CertificateRejected, match="too many terms"):
        decide(model, proof)


def test_several_outputs_have_one_multiplier_on_the_whole_box() -> None:
    """Two runs may be in different halves, and no point between them need obey both equations."""
    model, proof = claim("constant")
    model["p"] = {"exponents": [[2, 0]], "coefficients": [[0.1, 0.1]]}
    N = proof["proof"]["multipliers"]
    assert not oracle.agrees(proof, {MODEL: model}) or decide(model, proof)
    proof["proof"]["multipliers"] = {"split": 0, "parts": [N, N]}
    with pytest.raises(CertificateRejected, match="split"):
        decide(model, proof)
    assert not oracle.agrees(proof, {MODEL: model})


@pytest.mark.parametrize("name", NAMES)
def test_what_is_written_validates_and_a_damaged_claim_does_not(name: str) -> None:
    schema = files.load_document(SCHEMAS / "proof_dissipation.schema.json")
    _, proof = claim(name)
    jsonschema.validate(proof, schema)
    proof["claim"]["supply"]["gain"] = 1.0
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(proof, schema)


def test_a_written_loop_validates_and_a_witness_does_not() -> None:
    schema = files.load_document(SCHEMAS / "proof_small_gain.schema.json")
    document, _ = loop()
    jsonschema.validate(document, schema)
    document["proof"] = {"P": 1}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(document, schema)


# -- loops -----------------------------------------------------------------------------------


def rebound(document: Json, about: dict[str, Json]) -> dict[str, Json]:
    """Every digest made to fit: only what is claimed can be refused."""
    for role in ("first", "second"):
        own = about[f"{role}.proof.json"]["claim"]["about"]["model"]
        own["digest"] = files.digest(about[own["file"]])
        binding = document["claim"]["about"][role]
        binding["digest"] = files.digest(about[binding["file"]])
    return about


def test_a_loop_of_small_gains_is_proved_in_these_words() -> None:
    document, about = loop()
    verdict = proofs.decide(document, about)
    one, two = (
        Fraction(about[f"{role}.proof.json"]["claim"]["supply"]["number"])
        for role in ("first", "second")
    )
    assert verdict.margin == 1 - one * two
    assert verdict.statement == (
        "small gain: with u1 = r1 + y2 and u2 = r2 + y1, or either sum a difference, two models "
        "have one next sample from every past; two runs of their loop satisfy |dy1| <= 1.732 |dr1| "
        "+ 0.9233 |dr2| and |dy2| <= 0.9233 |dr1| + 1.026 |dr2|, |.| the root of the sum of "
        "squares up to any sample, where both have one past; with one r1 and one r2 the squares of "
        "dy1 and dy2 have finite sums from any two pasts; (1) for every input: dy1 the difference "
        "of speed in units of 1 m/s, du1 that of command in units of 1 V; (2) for every input: dy2 "
        "the difference of voltage in units of 1 V, du2 that of heard in units of 1 m/s"
    )
    assert oracle.agrees(document, about)
    for shown, exact in ((1.732, one), (1.026, two), (0.9233, one * two)):
        assert exact / (1 - one * two) <= Fraction(shown) < exact / (1 - one * two) * 2


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_runs_of_a_proved_loop_obey_the_printed_bounds(sign: float) -> None:
    """y1 = a1 y1 + b0 u1 + b1 u1(t-1), both with feedthrough: the sample's equations are solved."""
    _, about = loop()
    (a1, b1), (a2, b2) = (
        (about[f"{role}.model.json"]["a"][0], about[f"{role}.model.json"]["b"])
        for role in ("first", "second")
    )
    rng = np.random.default_rng(3)
    for _ in range(200):
        r = (
            rng.normal(size=(80, 2))
            * (rng.random(size=(80, 2)) < rng.random())
            * rng.normal(size=2)
        )
        y, u, ys = np.zeros(2), np.zeros(2), []
        for now in r:
            free = np.array([a1 * y[0] + b1[1] * u[0], a2 * y[1] + b2[1] * u[1]])
            # y1 = free1 + b1_0 (r1 + sign y2), y2 = free2 + b2_0 (r2 + y1)
            M = np.array([[1.0, -b1[0] * sign], [-b2[0], 1.0]])
            y = np.linalg.solve(M, free + np.array([b1[0] * now[0], b2[0] * now[1]]))
            u = np.array([now[0] + sign * y[1], now[1] + y[0]])
            ys.append(y)
        out, push = np.linalg.norm(ys, axis=0), np.linalg.norm(r, axis=0)
        assert out[0] <= 1.732 * push[0] + 0.9233 * push[1] + 1e-12
        assert out[1] <= 0.9233 * push[0] + 1.026 * push[1] + 1e-12


def forged_loop(what: str) -> tuple[Json, dict[str, Json], str]:
    document, about = loop()
    first, second = (about[f"{role}.proof.json"] for role in ("first", "second"))
    if what == "product":
        first["claim"]["supply"]["number"] = 1 / second["claim"]["supply"]["number"] * 1.0000001
        return document, about, "product"
    if what == "too small":
        first["claim"]["supply"]["number"] *= 0.99
        return document, about, "first: the growth"
    if what == "discount":
        second["claim"]["discount"] = 0.99
        return document, about, "discount 1"
    if what == "passivity":
        model, proof = claim("passive")
        about["first.model.json"] = model
        proof["claim"]["about"]["model"]["file"] = "first.model.json"
        about["first.proof.json"] = proof
        return document, about, "claim a gain"
    if what == "box":
        model, proof = claim("moving")
        about["first.model.json"] = model
        proof["claim"]["about"]["model"]["file"] = "first.model.json"
        about["first.proof.json"] = proof
        return document, about, "every input and output"
    if what == "period":
        about["second.model.json"]["period"] = 0.2
        return document, about, "periods"
    if what == "unit":
        about["second.model.json"]["y"]["unit"] = "mV"
        return document, about, "the second's outputs are not the first's inputs: the units"
    if what == "scale":
        second["claim"]["scales"] = {"u": [2.0], "y": [2.0]}
        second["proof"]["P"] = [[entry / 4 for entry in row] for row in second["proof"]["P"]]
        return document, about, "the scales differ"
    if what == "stability":
        first["claim"] = {"kind": "stability", "about": first["claim"]["about"], "rate": 0.9}
        return document, about, "dissipation"
    assert what == "witness"
    document["proof"] = {"multipliers": []}
    return document, about, "multipliers"


@pytest.mark.parametrize(
    "what",
    ["product", "too small", "discount", "passivity", "box", "period", "unit", "scale",
     "stability", "witness"],
)  # fmt: skip
def test_a_forged_loop_is_refused(what: str) -> None:
    document, about, reason = forged_loop(what)
    rebound(document, about)
    with pytest.raises(CertificateRejected, match=reason):
        proofs.decide(document, about)
    assert what == "witness" or not oracle.agrees(document, about)
