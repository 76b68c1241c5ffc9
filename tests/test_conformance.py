"""Files that other projects test their readers with: MCAP's conformance suite, rosbag2, a robot."""

import json
from pathlib import Path
from typing import Any

import pytest

from bags.mcap_file import McapFile
from tests.conftest import SHARED

SUITE = SHARED / "mcap_conformance"
RESOURCES = SHARED / "rosbag2_resources"
COUGARS = SHARED / "cougars_auv" / "SO_lastbag_mcap"
needs_suite = pytest.mark.skipif(not SUITE.is_dir(), reason=f"needs {SUITE.name} in ../shared/data")
needs_resources = pytest.mark.skipif(
    not RESOURCES.is_dir(), reason=f"needs {RESOURCES.name} in ../shared/data"
)


def stated(file: Path) -> dict[str, list[dict[str, Any]]]:
    """The records the suite says are in a file: type -> fields by name."""
    records: dict[str, list[dict[str, Any]]] = {}
    for record in json.loads(file.read_text())["records"]:
        fields = dict(record["fields"])
        known = records.setdefault(record["type"], [])
        if fields not in known or record["type"] == "Message":
            known.append(fields)
    return records


def data_of(field: list[str]) -> bytes:
    return bytes(map(int, field))


@needs_suite
@pytest.mark.parametrize(
    "folder", sorted(p.name for p in SUITE.glob("*/")) if SUITE.is_dir() else []
)
def test_every_file_of_the_suite_holds_what_its_description_states(folder: str) -> None:
    files = sorted((SUITE / folder).glob("*.mcap"))
    assert files
    for path in files:
        wanted = stated(path.with_suffix(".json"))
        with McapFile(path) as file:
            found = file.contents
            assert found.ending is None
            header = wanted["Header"][0]
            assert (found.profile, found.library) == (header["profile"], header["library"])
            assert {(str(s.id), s.name, s.encoding, s.data) for s in found.schemas.values()} == {
                (s["id"], s["name"], s["encoding"], data_of(s["data"]))
                for s in wanted.get("Schema", [])
            }
            assert {
                (str(c.id), str(c.schema_id), c.topic, c.message_encoding)
                for c in found.channels.values()
            } == {
                (c["id"], c["schema_id"], c["topic"], c["message_encoding"])
                for c in wanted.get("Channel", [])
            }
            assert [(m.name, m.metadata) for m in found.metadata] == [
                (m["name"], m["metadata"]) for m in wanted.get("Metadata", [])
            ]
            assert [
                (a.name, a.media_type, str(a.log_time), str(a.create_time), file.attachment_data(a))
                for a in found.attachments
            ] == [
                (a["name"], a["media_type"], a["log_time"], a["create_time"], data_of(a["data"]))
                for a in wanted.get("Attachment", [])
            ]
            messages = [
                (str(c), str(batch.sequence[i]), str(batch.log_ns[i]), str(batch.publish_ns[i]),
                 batch.data(i))
                for c, batch in file.batches(list(found.channels))
                for i in range(len(batch))
            ]  # fmt: skip
            assert messages == [
                (m["channel_id"], m["sequence"], m["log_time"], m["publish_time"],
                 data_of(m["data"]))
                for m in wanted.get("Message", [])
            ]  # fmt: skip
            assert sum(found.counts.values()) == len(messages)


@needs_suite
def test_the_suite_is_whole() -> None:
    assert len(list(SUITE.glob("*/*.mcap"))) == 416
