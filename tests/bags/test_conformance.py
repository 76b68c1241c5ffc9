"""Files that other projects test their readers with: MCAP's conformance suite, rosbag2, a robot."""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.recordings.bag import Bag
from bags.recordings.mcap_file import McapFile
from bags.recordings.message_types import decode
from bags.signals.columns import read_columns
from bags.signals.reader import read_signals
from bags.signals.signal import SignalPath, numeric_paths
from bags.tools.info import bag_info
from bags.tools.recover import recover
from nlsid_core.errors import BagError
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
        with closing(McapFile(path)) as file:
            found = file.contents
            assert found.ending is None
            assert {
                (str(s.id), s.name, s.encoding, s.data) for s in found.declared.schemas.values()
            } == {
                (s["id"], s["name"], s["encoding"], data_of(s["data"]))
                for s in wanted.get("Schema", [])
            }
            assert {
                (str(c.id), str(c.schema_id), c.topic, c.message_encoding)
                for c in found.declared.channels.values()
            } == {
                (c["id"], c["schema_id"], c["topic"], c["message_encoding"])
                for c in wanted.get("Channel", [])
            }
            assert [(m.name, m.metadata) for m in found.metadata] == [
                (m["name"], m["metadata"]) for m in wanted.get("Metadata", [])
            ]
            assert [
                (a.name, a.media_type, str(a.log_time), str(a.create_time), a.data)
                for a in file.attachments()
            ] == [
                (a["name"], a["media_type"], a["log_time"], a["create_time"], data_of(a["data"]))
                for a in wanted.get("Attachment", [])
            ]
            messages = [
                (
                    str(c),
                    str(batch.sequence[i]),
                    str(batch.log_ns[i]),
                    str(batch.publish_ns[i]),
                    batch.data(i),
                )
                for block in found.blocks
                for c, batch in file.block_batches(block, list(found.declared.channels))
                for i in range(len(batch))
            ]
            assert messages == [
                (
                    m["channel_id"],
                    m["sequence"],
                    m["log_time"],
                    m["publish_time"],
                    data_of(m["data"]),
                )
                for m in wanted.get("Message", [])
            ]
            assert sum(found.counts.values()) == len(messages)


@needs_suite
def test_the_suite_is_whole() -> None:
    assert len(list(SUITE.glob("*/*.mcap"))) == 416


PY = RESOURCES / "rosbag2_py" / "test" / "resources"
CPP = RESOURCES / "rosbag2_cpp" / "test" / "rosbag2_cpp" / "bags"
TESTS = RESOURCES / "rosbag2_tests" / "resources"
TRANSPORT = RESOURCES / "rosbag2_transport" / "test" / "resources"


def logged(path: Path, *, unfinished: bool = False) -> list[tuple[str, int, bytes]]:
    with Bag(path, unfinished=unfinished) as bag:
        messages = [(m.topic, m.log_time_ns, m.data) for m in bag.messages()]
        assert len(messages) == sum(bag.count(topic) for topic in bag.topics)
    return messages


@needs_resources
@pytest.mark.parametrize(
    ("folder", "messages"),
    [
        (PY / "{}" / "convert_a", 150),
        (PY / "{}" / "convert_b", 75),
        (PY / "{}" / "talker", 20),
        (TESTS / "{}" / "bag_with_topics_and_service_events", 10),
        (TESTS / "{}" / "cdr_test", 7),
        (TRANSPORT / "{}" / "rewriter_a", 150),
        (TRANSPORT / "{}" / "test_bag_for_seek", 5),
    ],
    ids=lambda value: value.name if isinstance(value, Path) else str(value),
)
def test_mcap_and_sqlite3_twins_have_all_their_messages(folder: Path, messages: int) -> None:
    for storage in ("mcap", "sqlite3"):
        assert len(logged(Path(str(folder).format(storage)))) == messages, storage


@needs_resources
def test_the_split_bag_of_five_files_is_one_with_stamps_2_ns_apart() -> None:
    for storage in ("mcap", "sqlite3"):
        messages = logged(PY / storage / "wbag")
        assert len(messages) == 6074
        times = [time for _, time, _ in messages]
        assert times == sorted(times)
        assert (times[0], times[-1]) == (1000, 2998)
        with Bag(PY / storage / "wbag") as bag:
            assert len(bag.files) == 5
    info = bag_info(PY / "mcap" / "wbag")
    assert {topic.times.interval for topic in info.topics} == {2e-9}


@needs_resources
def test_service_event_schemas_spoil_only_their_own_topics() -> None:
    with Bag(TESTS / "mcap" / "bag_with_topics_and_service_events") as bag:
        readable = []
        for topic in bag.topics:
            try:
                bag.types_on(topic)
            except BagError as error:
                assert "_service_event" in str(error)  # noqa: PT017
            else:
                readable.append(topic)
    assert readable
    assert not [topic for topic in readable if topic.endswith("_service_event")]
    for name in ("only_services.mcap", "topics_and_services.mcap", "topics_and_services.db3"):
        assert logged(CPP / name)


@needs_resources
def test_a_serialisation_that_is_not_cdr_is_refused_by_name() -> None:
    for storage in ("mcap", "sqlite3"):
        with pytest.raises(BagError, match="'wrong_format', only 'cdr' is read"):
            read_signals(TESTS / storage / "wrong_rmw_test", ["/test_topic:data"])


@needs_resources
def test_bags_without_messages_metadata_or_files(tmp_path: Path) -> None:
    empty = RESOURCES / "ros2bag" / "test" / "resources" / "empty_bag"
    assert logged(empty) == []
    for storage in ("mcap", "sqlite3"):
        unclosed = PY / storage / "reindex_test_bags" / "multiple_files"
        with pytest.raises(BagError, match=r"no metadata\.yaml: the recording was not closed"):
            logged(unclosed)
        assert len(logged(unclosed, unfinished=True)) == 3177
        assert recover(unclosed, tmp_path / storage).messages == 3177
    with pytest.raises(BagError, match="is not a bag: it holds no"):
        logged(TESTS / "empty_dir")


@pytest.mark.skipif(not COUGARS.is_dir(), reason="needs cougars_auv in ../shared/data")
def test_the_replayed_bag_of_a_real_vehicle() -> None:
    info = {topic.topic: topic for topic in bag_info(COUGARS, messages=True).topics}
    assert sum(topic.count for topic in info.values()) == 18558
    command = info["/coug2/controls/command"]
    assert (command.msgtype, command.count) == ("frost_interfaces/msg/UCommand", 1494)
    assert command.times.rate == pytest.approx(12.5, abs=0.01)
    for name in ("/coug2/controls/command", "/coug2/depth_data", "/coug2/dvl/velocity"):
        said = info[name].messages
        assert said is not None
        assert said.stamps is not None
        clock = said.stamps.clock
        assert clock is not None
        assert clock.offset == pytest.approx(-514_944, abs=0.1)
        assert clock.drift == 0.0
    assert info["/coug2/dvl/velocity"].times.longest == pytest.approx(0.77, abs=0.01)
    assert info["/coug2/battery/data"].times.gaps > 1000  # it comes in bursts
    read = read_signals(
        COUGARS, ["/coug2/controls/command:fin[*]", "/coug2/depth_data:pose.pose.position.z"]
    )
    fins = [read[f"/coug2/controls/command:fin[{k}]"].values for k in range(4)]
    assert np.max(np.abs(fins)) == 35.0
    depth = read["/coug2/depth_data:pose.pose.position.z"].values
    assert len(depth) == 1566
    assert (depth.min(), depth.max()) == pytest.approx((-1.10, -0.26), abs=0.01)


@pytest.mark.skipif(not COUGARS.is_dir(), reason="needs cougars_auv in ../shared/data")
def test_every_number_of_a_real_bag_is_what_the_decoder_gives_bit_for_bit() -> None:
    compared = 0
    with Bag(COUGARS) as bag:
        for topic in bag.topics:
            if not bag.count(topic):
                continue
            kind, types = bag.types_on(topic)
            texts = [path for path, *_ in numeric_paths(kind, types) if "[*]" not in path]
            paths = {text: SignalPath.parse(f"{topic}:{text}") for text in texts}
            columns = read_columns(bag, paths)[topic] if paths else None
            for row, message in enumerate(bag.messages([topic])):
                decoded = decode(message.data, kind, types)
                for text, path in paths.items():
                    assert columns is not None
                    found, wanted = columns.values[text][row], path.value(decoded)
                    assert found == wanted or (np.isnan(found) and np.isnan(wanted))
                    compared += 1
    assert compared > 150_000
