"""A sampled funnel's documents validate against their schemas; damaged ones do not."""

from pathlib import Path

import jsonschema
import pytest

from nlsid_core import files
from tests.tracked import designed, write

SCHEMAS = Path(__file__).resolve().parents[2] / "docs" / "schema"
FILES = {
    "model.json": "model_state_map",
    "policy.json": "policy_sampled",
    "funnel.json": "funnel_sampled",
    "funnel.proof.json": "proof_sampled_funnel",
}


@pytest.mark.parametrize(("file", "name"), FILES.items())
def test_a_sampled_funnels_document_validates_and_a_damaged_one_does_not(
    file: str, name: str, tmp_path: Path
) -> None:
    write(designed(), tmp_path)
    schema = files.load_document(SCHEMAS / f"{name}.schema.json")
    jsonschema.Draft202012Validator.check_schema(schema)
    document = files.load_document(tmp_path / file)
    jsonschema.validate(document, schema)
    for damaged in (document | {"extra": 1}, {k: v for k, v in document.items() if k != "format"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, schema)
