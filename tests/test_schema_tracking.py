"""A discrete funnel's documents validate against their schemas; damaged ones do not."""

from pathlib import Path

import jsonschema
import pytest

from nlsid_core import _json
from tests.tracked import designed, write

SCHEMAS = Path(__file__).resolve().parent.parent / "docs" / "schema"
FILES = {
    "model.json": "model_state_map",
    "policy.json": "policy_time_varying",
    "funnel.json": "funnel_discrete",
    "funnel.proof.json": "proof",
}


@pytest.mark.parametrize(("file", "name"), FILES.items())
def test_a_discrete_funnels_document_validates_and_a_damaged_one_does_not(
    file: str, name: str, tmp_path: Path
) -> None:
    write(designed(), tmp_path)
    schema = _json.load_document(SCHEMAS / f"{name}.schema.json")
    jsonschema.Draft202012Validator.check_schema(schema)
    document = _json.load_document(tmp_path / file)
    jsonschema.validate(document, schema)
    for damaged in (document | {"extra": 1}, {k: v for k, v in document.items() if k != "format"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, schema)
