"""The published JSON schema accepts every genuine proof and refuses strangers."""

import json
from pathlib import Path

import pytest

from tests.forgeries.genuine import genuine

jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
SCHEMA = Path(__file__).parent.parent / "docs" / "schema" / "proof-polynomial.schema.json"


@pytest.mark.parametrize("kind", sorted(genuine()))
def test_a_genuine_proof_meets_the_schema(kind: str) -> None:
    jsonschema.validate(genuine()[kind], json.loads(SCHEMA.read_text()))


def test_an_unknown_member_does_not_meet_the_schema() -> None:
    document = genuine()["bound"]
    forged = document | {"claim": document["claim"] | {"note": "trust me"}}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(forged, json.loads(SCHEMA.read_text()))
