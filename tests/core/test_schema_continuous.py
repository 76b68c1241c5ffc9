"""Continuous funnels' documents validate against their schemas, and damaged ones do not."""

from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from bags.chain.problems import FunnelProblem
from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.dynamics import MeasuredPush, Nominal
from tests.continuous_stage import stage

ROOT = Path(__file__).resolve().parents[2]
SCHEMAS, CORPUS = ROOT / "docs" / "schema", ROOT / "tests" / "core" / "kernel" / "corpus"
FILES = {
    "vector_field.json": "vector_field",
    "policy.json": "policy_continuous",
    "funnel.json": "funnel_continuous",
    "claim.proof.json": "proof_continuous_funnel",
}


def judged(document: Json, name: str) -> None:
    """It validates; with a member more or less it does not."""
    schema = files.load_document(SCHEMAS / f"{name}.schema.json")
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(document, schema)
    for damaged in (document | {"extra": 1}, {k: v for k, v in document.items() if k != "format"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, schema)


@pytest.mark.parametrize("case", ["clipped", "held", "pushed"])
@pytest.mark.parametrize(("file", "name"), FILES.items())
def test_a_continuous_funnels_documents_validate(case: str, file: str, name: str) -> None:
    judged(files.load_document(CORPUS / "continuous_funnel" / case / file), name)


def test_a_composition_validates() -> None:
    (case,) = (CORPUS / "funnel_composition").iterdir()
    judged(files.load_document(case / "claim.proof.json"), "proof_funnel_composition")


def test_a_proof_without_a_piece_of_its_witness_does_not_validate() -> None:
    schema = files.load_document(SCHEMAS / "proof_continuous_funnel.schema.json")
    whole = CORPUS / "continuous_funnel" / "held" / "claim.proof.json"
    for role in ("pieces", "rate_pieces"):
        proof = files.load_document(whole)
        del proof["proof"][role][0]["squares"]
        with pytest.raises(jsonschema.ValidationError, match="'squares' is a required property"):
            jsonschema.validate(proof, schema)


def test_a_problem_validates_with_what_may_be_left_out_or_without() -> None:
    field, policy, _ = stage()
    asked = FunnelProblem(field, Nominal(policy.x, policy.u), np.eye(1), hold="largest")
    judged(asked.document(), "funnel_problem")
    push = MeasuredPush(np.ones((1, 1)), (("a bag", "0" * 64),), 0.02, 1.5)
    judged(replace(asked, push=push).document(), "funnel_problem")
    needed = ("format", "version", "vector_field", "nominal", "goal")
    judged({key: asked.document()[key] for key in needed}, "funnel_problem")
