"""The second kernel: Coq builds it, accepts what is true, and refuses what is forged."""

import random
import re
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from benchmarks.verified import generator, mutated
from nlsid import design, f1tenth
from nlsid_core import files as saved
from nlsid_core import kernel, proofs, second
from nlsid_core.errors import CertificateRejected
from nlsid_core.progress import silent
from tests.core.kernel import mutations, stability_claims
from tests.core.kernel.held_claims import claim
from tests.core.kernel.sampled_claims import one_step
from tests.core.kernel.stability_forgeries import CHANGES
from tests.edits import Edit, both, exchanged, put, scaled, without
from tests.falling_pendulum import tracking
from tests.forged_held import HELD_FORGERIES
from tests.forged_tracking import FORGERIES
from tests.funnel_files import (
    FIELD,
    FUNNEL,
    POLICY,
    Files,
    files_of,
    forged_by,
    read,
    write,
)
from tests.tracked import designed
from tests.verbs import nlsid

Json = dict[str, Any]
ROOT = Path(__file__).resolve().parents[3]
VERIFIED = ROOT / "verified"
CORPUS = ROOT / "tests" / "core" / "kernel" / "corpus"
FUNNELS = CORPUS / "continuous_funnel"
CLAIM = "claim.proof.json"
GAPS = re.compile(r"\b(Admitted|admit|Axioms?|Parameters?|Conjectures?|Unset \w+ Checking)\b")

pytestmark = pytest.mark.timeout(3600)  # the theory is built once, also on a slow machine

needs_coq = pytest.mark.skipif(
    shutil.which("coqc") is None or shutil.which("make") is None,
    reason="Coq is not here (Debian: apt install coq libcoq-bignums make)",
)


def test_nothing_is_left_to_believe_in_the_theory() -> None:
    sources = sorted(VERIFIED.glob("*.v"))
    assert len(sources) > 5
    for source in sources:
        assert not GAPS.search(source.read_text()), source.name


def test_the_page_quotes_theorems_as_they_are() -> None:
    """Every theorem and definition on docs/verified.md is, sign by sign, one of the sources."""
    sources = [path.read_text() for path in VERIFIED.glob("*.v")]
    made = vars(generator().theorems).values()
    stated = "\n".join([*sources, *(text for text in made if type(text) is str)])
    page = (ROOT / "docs" / "verified.md").read_text()
    blocks = map(textwrap.dedent, re.findall(r"(?:^ {4,}\S.*\n)+", page, re.MULTILINE))
    quotes = [
        quote
        for block in blocks
        for quote in re.split(r"^(?=Theorem|Definition)", block, flags=re.MULTILINE)
        if quote.startswith(("Theorem", "Definition"))
    ]
    assert len(quotes) == 12
    for quote in quotes:
        assert quote in stated


def test_the_page_counts_the_lines_that_are_to_be_read() -> None:
    page = (ROOT / "docs" / "verified.md").read_text()
    counted = re.findall(r"`verified/(\w+\.v)`, (\d+) lines", page)
    assert len(counted) == 3
    for name, lines in counted:
        assert len((VERIFIED / name).read_text().splitlines()) == int(lines)


def test_every_premise_is_met_by_a_real_run() -> None:
    """Whatever is called a solution in the theory is concluded of real runs in Runs.v."""
    sources = "".join(path.read_text() for path in VERIFIED.glob("*.v"))
    premises = set(re.findall(r"Definition (\w*solution) ", sources))
    assert premises == {"solution", "held_solution"}
    runs = re.findall(r"Theorem (.*?)\.\nProof", (VERIFIED / "Runs.v").read_text(), re.DOTALL)
    for premise in (*premises, "motion", "run"):
        assert any(re.search(rf"\b{premise}\b", theorem) for theorem in runs), premise


def theorem(name: str = "tube/engaged") -> str:
    """What the generator writes for Coq."""
    generate = generator()
    return str(generate.coq(generate.read(CORPUS / name / "claim.proof.json")))


@pytest.mark.parametrize(
    "line",
    [
        "Axiom _hidden : False.",
        "Axiom hidden : False.",
        "Parameter found : forall d x, solution d x.",
        "Definition stays_near := (None).",
        "Definition data := (Linear []). Axiom _hidden : False.",
        "Definition rate := (proj1_sig _hidden).",
        "Definition rate := (fun x => x).",
        'Notation "x <= y" := True.',
        "Unset Guard Checking.",
        "From Coq Require Import Berardi.",
        "",
    ],
)
def test_a_line_that_is_not_of_the_template_is_refused(line: str) -> None:
    theorems, text = generator().theorems, theorem()
    assert theorems.proved(text) == ["accepted", "near", "planned", "near_plan"]
    lines = text.splitlines(keepends=True)
    for i in range(len(lines) + 1):
        with pytest.raises(theorems.NotTemplate):
            theorems.proved("".join([*lines[:i], f"{line}\n", *lines[i:]]))


@pytest.mark.parametrize(
    "assumed",
    [
        "_hidden : False",
        "hidden : False",
        "Classical_Prop.classic : forall P : Prop, P",
        "PrimInt63.int : Prop",
        "proof_irrelevance is assumed to be guarded.",
        "Section Variables:",
    ],
)
def test_an_assumption_that_is_not_listed_with_its_type_is_refused(assumed: str) -> None:
    theorems = generator().theorems
    answer = "Axioms:\n" + theorems.ALLOWED.read_text()
    theorems.hold_assumptions(answer, 1)
    for wrong, asked in ((f"{answer}{assumed}\n", 1), (answer, 2), ("", 1)):
        with pytest.raises(theorems.NotTemplate):
            theorems.hold_assumptions(wrong, asked)


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the theory is built, once."""
    folder = tmp_path_factory.mktemp("verified")
    command = ["make", "-C", str(VERIFIED), f"BUILD={folder}"]
    subprocess.run(command, check=True, capture_output=True)
    return folder


def accepted(proof: Path, build: Path) -> subprocess.CompletedProcess[str]:
    """The build of the theorem of one file."""
    command = ["make", "-C", str(VERIFIED), f"BUILD={build}", f"FILE={proof}"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@needs_coq
@pytest.mark.coq
def test_a_hidden_axiom_is_seen(tmp_path: Path) -> None:
    """The name of 0.2's, which no name in a list begins with."""
    theorems = generator().theorems
    (tmp_path / "hiding.v").write_text("Axiom _hidden : False.\nDefinition said := _hidden.\n")
    (tmp_path / "asked.v").write_text(theorems.question(["said"], "hiding"))
    for file in ("hiding.v", "asked.v"):
        command = ["coqc", "-q", file]
        done = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True)
    with pytest.raises(theorems.NotTemplate, match="_hidden : False"):
        theorems.hold_assumptions(done.stdout, 1)


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize("name", ["clipped", "pushed", "held"])
def test_coq_proves_the_theorem_of_a_funnel(name: str, build: Path) -> None:
    done = accepted(FUNNELS / name / "claim.proof.json", build)
    assert done.returncode == 0, done.stderr
    assert "accepted: " in done.stdout
    text = (build / "theorem.v").read_text()
    assert ("held_in_bounds data x u t" if name == "held" else "in_bounds data x t") in text


def pushed_by_the_state(files: Files) -> None:
    """x0 w0 in the place of w0: the centre and kappa do not cover it."""
    exponents = files[FIELD]["pieces"][0][1]["exponents"]
    row = next(row for row in exponents if row[4] == 1)
    row[1] = 1
    exponents.sort()


def valid(entry: float) -> Edit:
    """The equations are said to be valid for a hundredth of a unit of this entry of (x, u) only."""
    return put(f"{FIELD} valid", [[entry, -0.01, 0.01]])


MU = f"{CLAIM} proof pieces 3 mu"
CONTINUOUS: dict[tuple[str, str], Edit] = {
    ("clipped", "rho raised"): scaled(f"{FUNNEL} rho 1", 1.001),
    ("clipped", "gain lower"): scaled(f"{POLICY} K", 0.5),
    ("clipped", "multiplier's sign"): both(scaled(f"{MU} start", -1), scaled(f"{MU} end", -1)),
    ("clipped", "piece missing"): without(f"{CLAIM} proof pieces 7"),
    ("clipped", "limit wider"): scaled(f"{POLICY} limits 0 2", 2.0),
    ("clipped", "goal smaller"): scaled(f"{CLAIM} claim goal P", 1.5),
    ("clipped", "bounds too narrow"): valid(0.0),
    ("clipped", "input's bounds too narrow"): valid(1.0),
    ("pushed", "bounds too narrow"): valid(0.0),
    ("pushed", "input's bounds too narrow"): valid(2.0),
    ("pushed", "kappa smaller"): scaled(f"{CLAIM} proof kappa", 0.05),
    ("pushed", "pushed more"): scaled(f"{FIELD} uncertain", 20.0),
    ("pushed", "pushed by the state"): pushed_by_the_state,
    ("held", "rho raised"): scaled(f"{FUNNEL} rho 1", 1.001),
    ("held", "gain lower"): scaled(f"{POLICY} K", 0.5),
    ("held", "input's bounds too narrow"): valid(1.0),
    ("held", "held longer"): scaled(f"{CLAIM} claim hold", 3.0),
    ("held", "measured worse"): put(f"{CLAIM} claim error", [0.02]),
    ("held", "turns more slowly"): scaled(f"{CLAIM} proof rates 0 0", 1 / 3),
}


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize("forgery", CONTINUOUS, ids=" ".join)
def test_both_kernels_refuse_a_forgery(
    forgery: tuple[str, str], build: Path, tmp_path: Path
) -> None:
    proof = write(forged_by(CONTINUOUS[forgery], read(FUNNELS / forgery[0])), tmp_path)
    with pytest.raises(CertificateRejected):
        proofs.check(proof)
    done = accepted(proof, build)
    assert done.returncode != 0
    assert "theorem.v" in done.stderr, "refused by Coq, not before"


MODELS = (
    "tube/engaged",
    "tube/lasting_linear",
    "tube/lasting_monotone",
    "tube/lasting_split",
    "tube/lasting_two_outputs",
    "tube/lasting_implicit_ray",
    "tube/lasting_network",
    "tube/lasting_cascade",
    "stability/linear",
    "stability/network",
    "stability/cascade",
    "stability/moving_lags",
    "stability/split",
    "stability/two_outputs",
)


SAMPLED = "sampled_funnel/response"
COMPOSED = "funnel_composition/two"


@pytest.mark.parametrize(
    "name",
    [
        *MODELS,
        SAMPLED,
        COMPOSED,
        "continuous_funnel/clipped",
        "continuous_funnel/pushed",
        "continuous_funnel/held",
    ],
)
def test_the_numbers_of_a_theorem_print_as_the_files(name: str) -> None:
    """And each of them counts: another one prints as another file."""
    generate = generator()
    problem = generate.read(CORPUS / name / "claim.proof.json")
    text = generate.coq(problem)
    generate.compared(problem, text)
    rng = random.Random(name)
    lines = text.splitlines()
    places = [i for i, line in enumerate(lines) if re.match(r"Definition .*[^0-9a-z_]\d", line)]
    assert len(places) > 1
    for i in rng.sample(places, min(len(places), 25)):
        head, assigned, term = lines[i].partition(" := ")
        digits = rng.choice(list(re.finditer(r"(?<![\w.])\d+", term)))
        more = str(int(digits[0]) + 2)
        changed = head + assigned + term[: digits.start()] + more + term[digits.end() :]
        with pytest.raises((generate.printed.Differs, IndexError, ValueError)):
            generate.compared(problem, "\n".join([*lines[:i], changed, *lines[i + 1 :]]))


def test_a_file_that_is_not_in_canonical_form_is_refused(tmp_path: Path) -> None:
    generate = generator()
    files = read(FUNNELS / "pushed")
    coefficients = files[FIELD]["pieces"][0][1]["coefficients"]
    assert coefficients[-1] == "1/6"
    coefficients[-1] = "2/12"
    problem = generate.read(write(files, tmp_path))
    with pytest.raises(generate.printed.Differs, match="2/12"):
        generate.compared(problem, generate.coq(problem))


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize("name", [*MODELS, SAMPLED, COMPOSED])
def test_coq_proves_the_theorem_of_a_model(name: str, build: Path) -> None:
    done = accepted(CORPUS / name / "claim.proof.json", build)
    assert done.returncode == 0, done.stderr
    assert "accepted: " in done.stdout


ASSUMED = "funnel.json tubes 0 assumption"


def wide_window(files: Files) -> None:
    """Four entries, and a monomial of degree 20 in each."""
    model = files["model.json"]
    model["window"] = [[0, 0], [0, 1], [0, 0], [0, 1]]
    for table in (*model["G"], model["p"]):
        table["exponents"] = [[*row, 0, 0] for row in table["exponents"]]
    model["p"]["exponents"][0] = [20, 20, 20, 20]


@pytest.mark.parametrize(
    ("name", "forge", "said"),
    [
        ("lasting_linear", put("model.json y name", "a\nb"), "no short printable text"),
        ("lasting_linear", put("model.json y units", "m"), "unknown members: 'units'"),
        ("lasting_linear", put("model.json period", True), "should be a number"),
        ("lasting_linear", put("model.json period", 0), "should be > 0"),
        ("lasting_linear", put("model.json u_range", [2, 1]), "low > high"),
        ("lasting_linear", put("funnel.json settling", 2.5), "0 to 1000000000 is allowed"),
        ("lasting_linear", put("funnel.json box", {}), "unknown members: 'box'"),
        ("lasting_linear", put("funnel.json tubes 0 rho", 1.0), "exactly for an energy"),
        ("lasting_linear", put(f"{ASSUMED} samples", 3), "unknown members: 'samples'"),
        (
            "lasting_linear",
            put("funnel.json tubes 0 follows", {"terms": [], "weights": [[]]}),
            "1 to 200 entries",
        ),
        ("lasting_linear", put("claim.proof.json proof multipliers", []), "unknown members"),
        ("lasting_split", put("model.json window 0", [0, 9]), "a delay of the window"),
        ("lasting_split", put("model.json y_scale 0", -1.0), "should be > 0"),
        ("lasting_two_outputs", put("model.json y 1 name", "y0"), "two signals of one name"),
        (
            "lasting_two_outputs",
            put("claim.proof.json proof multipliers 0 N", []),
            "3 to 3 entries",
        ),
        ("lasting_network", put("model.json into 0 0", 1.0), "a map should use earlier ones only"),
        ("lasting_network", put("model.json maps 0 knots 0", 5.0), "should increase"),
        ("lasting_cascade", put("model.json f spacing", 0.0), "the spacing should be > 0"),
        ("lasting_cascade", put("model.json f coefficients", [0.0, 1.0, 2.0]), "4 to"),
        ("lasting_cascade", put("model.json b1 1", [1.0]), "3 to 3 entries"),
        ("lasting_cascade", put("model.json b2", [[1.0]]), "2 to 2 entries"),
        (
            "lasting_implicit_ray",
            put("funnel.json box", {"y": [[-1, 1]], "u": [[-1, 1]]}),
            "a box of a model that needs none",
        ),
        ("engaged", put("policy.json u 0 0", 7.0), "outside the model's range"),
        ("engaged", put("policy.json period", 0.2), "another period"),
        ("engaged", put("policy.json L 0 0", 0.0), "L is not the policy's"),
        ("response", put("model.json kind", "map"), "should be one of state_map"),
        ("response", put("model.json x 1 name", "angle"), "two signals of one name"),
        ("response", put("model.json exponents 4", [0, 63, 63]), "a degree above 63"),
        ("response", put("model.json exponents 4", [0, 60, 0]), "too many monomials in a step"),
        ("response", put("policy.json period", 0.04), "another period"),
        ("response", put("policy.json L", [[1.0]]), "2 to 2 entries"),
        ("response", put("funnel.json tube 0", 5.0), "starts outside the inlet"),
        ("response", put("funnel.json roots", [1.0]), "unknown members: 'roots'"),
        ("response", put("funnel.json assumption rate", 0.5), "rate and gain 1"),
        ("response", put("funnel.json assumption gain", 2.0), "rate and gain 1"),
        ("response", put("funnel.json assumption form", "linear"), "should be one of response"),
        ("response", put("funnel.json assumption form", "energy"), "should be one of response"),
        ("response", put("claim.proof.json proof steps 0 kappa", -1.0), "kappa >= 0"),
        ("response", put("claim.proof.json proof steps 0 curvature", [-1.0]), "curvature >= 0"),
        ("response", put("claim.proof.json proof ball_basis", []), "1 to 200 entries"),
        ("response", put("claim.proof.json version", 2.0), "not of version 2"),
        ("response", put("model.json noise", 2**53 + 1), "a whole number beyond 2^53"),
        (
            "response",
            put("claim.proof.json proof steps 0 tube squares scale", 1),
            "unknown members",
        ),
        (
            "lasting_split",
            put(
                "funnel.json tubes 0 follows",
                {
                    "terms": [
                        {"inputs": ["0"], "of": "value", "centre": 0.0, "scale": 1.0, "fading": 0.5}
                    ],
                    "weights": [[1.0]],
                },
            ),
            "0 to 0 is allowed",
        ),
        ("lasting_split", wide_window, "a degree above 63"),
        (
            "lasting_split",
            put("model.json p", {"exponents": [], "coefficients": []}),
            "p has no monomials",
        ),
    ],
)
def test_a_file_that_the_pages_do_not_allow_is_refused(
    name: str, forge: Edit, said: str, tmp_path: Path
) -> None:
    """By both kernels; with the file as it is, both have nothing against it."""
    sampled = CORPUS / "sampled_funnel" / name
    folder, generate = sampled if sampled.exists() else CORPUS / "tube" / name, generator()
    files = read(folder)
    assert generate.decided(write(files, tmp_path)) == (0, "")
    forge(files)
    proof = write(files, tmp_path)
    status, why = generate.decided(proof)
    assert status == 1
    assert said in why
    with pytest.raises(CertificateRejected):
        proofs.check(proof)


def test_a_number_that_is_not_written_as_a_float64_is_refused(tmp_path: Path) -> None:
    folder, generate = CORPUS / "stability" / "linear", generator()
    files = read(folder)
    proof = write(files, tmp_path)
    claim = files["claim.proof.json"]["claim"]
    text = proof.read_text()
    proof.write_text(text.replace(str(claim["rate"]), str(claim["rate"]) + "00"))
    assert generate.decided(proof)[0] == 3, "that number, but not as it is printed"
    proof.write_text(text.replace(str(claim["rate"]), str(claim["rate"]) + "01"))
    assert generate.decided(proof)[0] == 1


def test_what_the_reader_refuses_the_first_kernel_refuses(tmp_path: Path) -> None:
    """Of mutants of tubes, stability and sampled funnels, without the checker of the numbers."""
    generate, rng = generator(), np.random.default_rng(3)
    kinds = ("tube", "stability", "sampled_funnel")
    cases = [case for case in mutations.corpus() if case.kind in kinds]
    refused = 0
    for k in range(120):
        forged = mutations.mutant(cases[k % len(cases)], rng)
        for name, document in {**forged.about, mutations.PROOF: forged.document}.items():
            (tmp_path / name).write_bytes(saved.encode(document))
        if generate.decided(tmp_path / mutations.PROOF)[0] == 1:
            refused += 1
            with pytest.raises(kernel.Rejected):
                kernel.check(tmp_path / mutations.PROOF)
    assert refused > 30


@needs_coq
@pytest.mark.coq
def test_the_kernels_do_not_disagree_about_mutants(program: Path, tmp_path: Path) -> None:
    found = mutated(1200, tmp_path / "mutant", program.parent / "second")
    assert found["differ"] == {}
    kinds = ("tube", "stability", "continuous_funnel", "sampled_funnel", "funnel_composition")
    for kind in kinds:
        assert min(found["decided"][f"{said} {kind}"] for said in ("accepted", "refused")) > 2


@pytest.fixture(scope="module")
def program(build: Path) -> Path:
    """The extracted checker."""
    zarith = ["ocamlfind", "query", "zarith"]
    if shutil.which("ocamlfind") is None or subprocess.run(zarith, check=False).returncode:
        pytest.skip("no OCaml (Debian: apt install ocaml-nox ocaml-findlib libzarith-ocaml-dev)")
    command = ["make", "-C", str(VERIFIED), f"BUILD={build}", "second"]
    subprocess.run(command, check=True, capture_output=True)
    return build / "nlsid-second"


TUBE = "funnel.json tubes 0"
TUBES: dict[str, tuple[str, Edit]] = {
    "the innovations are forgotten faster": ("lasting_two_outputs", scaled(f"{TUBE} rho", 0.6)),
    "narrower": ("lasting_two_outputs", scaled(f"{TUBE} half_widths", 0.9)),
    "tau larger": ("lasting_two_outputs", scaled(f"{TUBE} tau", 1.5)),
    "storage of another size": ("lasting_two_outputs", scaled(f"{TUBE} P", 0.1)),
    "indefinite": ("lasting_two_outputs", scaled(f"{TUBE} P", -1.0)),
    "outputs in another unit": ("lasting_two_outputs", scaled("model.json y_scale", 2.0)),
    "multipliers gone": (
        "lasting_two_outputs",
        scaled("claim.proof.json proof multipliers 0 N", 0.0),
    ),
    "feedback stronger": ("engaged", scaled("policy.json K", 10.0)),
    "spline steeper": ("lasting_cascade", scaled("model.json f coefficients", 4.0)),
    "filter stronger": ("lasting_cascade", scaled("model.json b2", 2.0)),
}


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize(("name", "forge"), TUBES.values(), ids=TUBES)
def test_both_kernels_refuse_a_forged_tube(
    name: str, forge: Edit, build: Path, program: Path, tmp_path: Path
) -> None:
    folder = CORPUS / "tube" / name
    files = read(folder)
    forge(files)
    proof = write(files, tmp_path)
    with pytest.raises(CertificateRejected):
        proofs.check(proof)
    assert second.opinion(proof, program).verdict == "refused"
    done = accepted(proof, build)
    assert done.returncode != 0
    assert "theorem.v" in done.stderr, "refused by Coq, not before"


@needs_coq
@pytest.mark.coq
def test_every_forged_sampled_funnel_is_refused(program: Path, tmp_path: Path) -> None:
    """Those that the first kernel's tests hold; the funnel that they were made of is accepted."""
    assert second.opinion(write(files_of(designed()), tmp_path), program).verdict == "accepted"
    for what, (forge, _) in FORGERIES.items():
        proof = write(forged_by(forge, files_of(designed())), tmp_path)
        assert second.opinion(proof, program).verdict == "refused", what


@needs_coq
@pytest.mark.coq
def test_every_forged_held_funnel_is_refused(program: Path, tmp_path: Path) -> None:
    """Those that the first kernel's tests hold; one whose input is held between samples."""
    files = files_of(design(tracking(hold=0.01, error=[0.002, 0.01])))
    assert second.opinion(write(files, tmp_path), program).verdict == "accepted"
    for what, (forge, _) in HELD_FORGERIES.items():
        proof = write(forged_by(forge, files), tmp_path)
        assert second.opinion(proof, program).verdict == "refused", what


@needs_coq
@pytest.mark.coq
def test_every_forged_stability_is_refused(program: Path, tmp_path: Path) -> None:
    """Those that the first kernel's tests hold."""
    for what, (name, change, _) in CHANGES.items():
        model, proof = stability_claims.claim(name)
        assert said_of(model, proof, program, tmp_path) == "accepted", name
        change(model, proof["proof"])
        assert said_of(model, proof, program, tmp_path) == "refused", what


def said_of(model: Json, proof: Json, program: Path, folder: Path) -> str:
    """What the second kernel says of a proof of stability."""
    files = {"model.json": model, "claim.proof.json": proof}
    return second.opinion(write(files, folder), program).verdict


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize(("low", "kept"), [(0.5, False), (1.0, False), (0.0, True)])
def test_a_bound_that_an_old_input_breaks_is_refused(
    low: float, kept: bool, program: Path, tmp_path: Path
) -> None:
    said = second.opinion(write(claim(low), tmp_path), program).verdict
    assert said == ("accepted" if kept else "refused")


@needs_coq
@pytest.mark.coq
def test_a_forged_sampled_funnel_has_no_theorem(build: Path, tmp_path: Path) -> None:
    forge, _ = FORGERIES["curvature made smaller"]
    proof = write(forged_by(forge, files_of(designed())), tmp_path)
    done = accepted(proof, build)
    assert done.returncode != 0
    assert "theorem.v" in done.stderr, "refused by Coq, not before"


@needs_coq
@pytest.mark.coq
def test_sampled_claims_are_decided_as_the_closed_form_decides(
    program: Path, tmp_path: Path
) -> None:
    generate, rng = generator(), random.Random(0)
    for i in range(20):
        claim, true = one_step(rng, 1e-5 if i % 2 else -1e-5)
        files: Files = {f"{role}.json": content for role, content in claim.documents().items()}
        about = {role: {"file": f"{role}.json"} for role in ("model", "policy", "funnel")}
        files["claim.proof.json"] = proofs.proof_document(
            {"kind": "sampled_funnel", "about": about}, claim.proof()
        )
        found, _ = generate.decided(write(files, tmp_path), checker=program.parent / "second")
        assert found == (0 if true else 1)


ABOUT = f"{mutations.PROOF} claim about"
COMPOSITIONS: dict[str, Edit] = {
    "stage 2 starts narrower": scaled("stage2.funnel.json rho 0", 0.99),
    "a multiplier above 1": put(f"{mutations.PROOF} proof multipliers", [1.01]),
    "a negative multiplier": put(f"{mutations.PROOF} proof multipliers", [-0.5]),
    "stages exchanged": exchanged(f"{ABOUT} stage1", f"{ABOUT} stage2"),
    "stage 1 follows itself": put(f"{ABOUT} stage2 file", "stage1.proof.json"),
    "stage 2 is driven the other way": scaled("stage2.policy.json K", -1.0),
}


@needs_coq
@pytest.mark.coq
@pytest.mark.parametrize("what", COMPOSITIONS)
def test_both_kernels_refuse_a_forged_composition(what: str, program: Path, tmp_path: Path) -> None:
    (case,) = (case for case in mutations.corpus() if case.kind == "funnel_composition")
    forged = case.copied()
    COMPOSITIONS[what]({**forged.about, mutations.PROOF: forged.document})
    mutations.bind_again(forged)
    for name, document in {**forged.about, mutations.PROOF: forged.document}.items():
        (tmp_path / name).write_bytes(saved.encode(document))
    with pytest.raises(kernel.Rejected):
        kernel.check(tmp_path / mutations.PROOF)
    status, why = generator().decided(tmp_path / mutations.PROOF, checker=program.parent / "second")
    assert (status, why) == (1, ""), "refused by the checker, not before"


@needs_coq
@pytest.mark.coq
def test_coq_proves_the_car_that_ships(build: Path, tmp_path: Path) -> None:
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, tmp_path, progress=silent)
    design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)
    for name in (documents.MODEL_PROOF, documents.FUNNEL_PROOF):
        done = accepted(tmp_path / name, build)
        assert done.returncode == 0, done.stderr
    assert "Theorem near_plan" in (build / "theorem.v").read_text()


@needs_coq
@pytest.mark.coq
def test_check_asks_the_second_kernel(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second, "BUILT", program)
    proved = CORPUS / "tube" / "lasting_linear" / "claim.proof.json"
    told = nlsid("check", "--second", proved)
    assert "second kernel: accepted by the checker that Coq proves right" in told
    beyond = CORPUS / "tube" / "lasting_implicit_box" / "claim.proof.json"
    told = nlsid("check", "--second", beyond, status=2)
    assert "increments are known on a box only" in told.replace("\n", " ")
    assert "PROVED" in told


def test_a_second_kernel_that_breaks_down_refuses_nothing(tmp_path: Path) -> None:
    """Its checker is not there: that is no verdict, and no disagreement."""
    broken = tmp_path / "nlsid-second"
    script = VERIFIED / "generate.py"
    broken.write_text(f"#!/bin/sh\nexec {sys.executable} {script} $1 --ask {tmp_path}/none\n")
    broken.chmod(0o755)
    proved = CORPUS / "tube" / "lasting_linear" / "claim.proof.json"
    told = second.opinion(proved, broken)
    assert told.verdict == "failed"
    assert "FileNotFoundError" in told.reason


def test_without_the_second_kernel_check_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(second, "BUILT", tmp_path / "nothing")
    monkeypatch.setenv("PATH", str(tmp_path))
    proved = CORPUS / "tube" / "lasting_linear" / "claim.proof.json"
    told = nlsid("check", "--second", proved, status=2)
    assert "PROVED tube" in told
    assert "not built here" in told
