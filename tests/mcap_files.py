"""MCAP files with schemas of any text, and bags as three readers read them."""

import struct
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from bags.recordings.bag import Bag


def write_mcap(file: Path, topics: dict[str, tuple[str, str]]) -> None:
    """One message on each topic of a (type, definition)."""
    with file.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2")
        for k, (topic, (kind, text)) in enumerate(topics.items()):
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, k, b"\0\1\0\0" + struct.pack("<d", 0.5), k)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates half of its writer


def three_readers(bag: Path, topic: str) -> list[list[bytes]]:
    """The messages on a topic as we, rosbags and mcap read them."""
    with Bag(bag) as source:
        ours, files = [m.data for m in source.messages([topic])], source.files
    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.topic == topic]
        rosbags = [bytes(data) for _, _, data in reader.messages(wanted)]
    mcap: list[bytes] = []
    for file in files:
        with file.open("rb") as stream:
            messages = make_reader(stream, validate_crcs=True).iter_messages([topic])
            mcap += [message.data for *_, message in messages]
    return [ours, rosbags, mcap]
