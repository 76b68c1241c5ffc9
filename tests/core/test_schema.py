"""What is written validates against the published schemas, and what is damaged does not."""

from pathlib import Path

import jsonschema
import pytest

from bags.designs.documents import FUNNEL, FUNNEL_PROOF, MODEL, MODEL_PROOF, POLICY
from nlsid_core import files

SCHEMAS = Path(__file__).resolve().parents[2] / "docs" / "schema"
FILES = {
    MODEL: "model",
    POLICY: "policy",
    FUNNEL: "funnel_tube",
    MODEL_PROOF: "proof_stability",
    FUNNEL_PROOF: "proof_output_tube",
}


def schema(name: str) -> dict[str, object]:
    return files.load_document(SCHEMAS / f"{name}.schema.json")


@pytest.mark.parametrize(("file", "name"), FILES.items())
def test_every_written_document_validates(design_folder: Path, file: str, name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(schema(name))
    jsonschema.validate(files.load_document(design_folder / file), schema(name))


@pytest.mark.parametrize(("file", "name"), FILES.items())
def test_a_document_with_a_missing_or_extra_key_does_not_validate(
    design_folder: Path, file: str, name: str
) -> None:
    document = files.load_document(design_folder / file)
    for damaged in (document | {"extra": 1}, {k: v for k, v in document.items() if k != "format"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, schema(name))
