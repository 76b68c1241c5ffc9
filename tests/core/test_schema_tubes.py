"""Tubes around a simulation validate against their published schemas, and damaged ones do not."""

from pathlib import Path

import jsonschema
import pytest

from nlsid_core import files
from nlsid_core.arrays import Json
from nlsid_core.designs import FUNNEL, PROOF
from tests.core.kernel.tube_claims import design
from tests.marks import slow_among

SCHEMAS = Path(__file__).resolve().parents[2] / "docs" / "schema"
FILES = {FUNNEL: "funnel_tube", PROOF: "proof_output_tube"}


@pytest.mark.parametrize(
    "name",
    slow_among(("linear", "split", "implicit_box", "two_following"), {"split", "two_following"}),
)
@pytest.mark.parametrize(("file", "schema"), FILES.items())
def test_every_written_document_validates_and_a_damaged_one_does_not(
    name: str, file: str, schema: str
) -> None:
    stated = files.load_document(SCHEMAS / f"{schema}.schema.json")
    validates(design(name).documents()[file], stated)


def validates(document: Json, stated: Json) -> None:
    """It does; with a member more or less it does not."""
    jsonschema.Draft202012Validator.check_schema(stated)
    jsonschema.validate(document, stated)
    for damaged in (document | {"extra": 1}, {k: v for k, v in document.items() if k != "format"}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(damaged, stated)
