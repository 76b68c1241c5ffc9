"""Bags are read where they lie, by the ranges that are needed, and refused by name if they fail."""

import pickle
import socket
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType

from bags.recordings.bag import Bag
from bags.recordings.folders import expand_bags
from bags.recordings.mcap_file import McapFile
from bags.recordings.mcap_records import index_offsets, walk_records
from bags.recordings.remote import Entry, RemotePath, is_url, place
from bags.samples import f1tenth
from bags.signals.reader import bag_origin, read_signals
from nlsid_core.errors import BagError
from tests.bag_messages import CMD, COMMAND, ODOM, SPEED
from tests.bags.fleet.conftest import Bucket
from tests.bags.fleet.storage import IMAGE, drive, web_server

WANTED = [SPEED, COMMAND]


def remote(url: str, patience: float = 60.0) -> RemotePath:
    path = place(url, patience=patience)
    assert isinstance(path, RemotePath)
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_remote_file_gives_the_same_signals_and_messages(
    bucket: Bucket, tmp_path: Path, compression: CompressionType
) -> None:
    local = drive(tmp_path / "d.mcap", image_bytes=3000, writer={"compression": compression})
    url = bucket.put(local, "a/d.mcap")
    found, wanted = read_signals(url, WANTED), read_signals(local, WANTED)
    for text in WANTED:
        np.testing.assert_array_equal(found[text].values, wanted[text].values)
        np.testing.assert_array_equal(found[text].stamp_ns, wanted[text].stamp_ns)
    with Bag(url) as there, Bag(local) as here:
        assert there.topics == here.topics
        assert [there.count(topic) for topic in there.topics] == [200, 200, 200]
        assert list(there.messages()) == list(here.messages())


ZSTD = {"compression": CompressionType.ZSTD}
# options of `drive`, topics, share of the file and requests at most: how long it is, its end, and
# of uncompressed chunks what lies between images
FETCHED = [
    ({"samples": 10}, [ODOM, CMD], 1.0, 2),  # a small file is fetched whole
    (
        {"samples": 100, "image_bytes": 100_000, "writer": {"chunk_size": 800_000}},
        [ODOM, CMD],
        0.012,
        2 + 100,
    ),
    ({"image_bytes": 30_000, "writer": {"chunk_size": 4000}}, [CMD], 0.1, 2 + 400),
    (
        {"samples": 60, "image_bytes": 100_000, "writer": {"chunk_size": 50_000, **ZSTD}},
        [IMAGE],
        1.05,
        2 + 60,
    ),
]


@pytest.mark.parametrize(("options", "topics", "share", "requests"), FETCHED)
def test_only_what_is_wanted_is_fetched(
    tmp_path: Path, options: dict[str, Any], topics: list[str], share: float, requests: int
) -> None:
    local = drive(tmp_path / "d.mcap", **options)
    with web_server(tmp_path) as url:
        path = remote(f"{url}/d.mcap")
        with Bag(path) as bag:
            count = sum(len(batch) for _, batch in bag.batches(topics))
        bag_origin(path)
    assert count == len(topics) * options.get("samples", 200)
    assert path.fetched <= share * local.stat().st_size
    assert path.requests <= requests


def test_a_rosbag2_folder_is_read_from_storage(bucket: Bucket) -> None:
    folder = f1tenth()[0]
    for file in folder.iterdir():
        url = bucket.put(file, f"{folder.name}/{file.name}").rpartition("/")[0]
    found = read_signals(url, [SPEED])
    np.testing.assert_array_equal(found[SPEED].values, read_signals(folder, [SPEED])[SPEED].values)


def test_patterns_mean_the_bags_that_match(bucket: Bucket, tmp_path: Path) -> None:
    local = drive(tmp_path / "d.mcap", samples=10)
    urls = [bucket.put(local, f"robot_{k}/drive_{k}.mcap") for k in (2, 1)]
    bucket.put(local, "robot_1/other.mcap")
    found = expand_bags([Path(f"s3://{bucket.name}/*/drive_*.mcap")])
    assert [str(path) for path in found] == sorted(urls)
    with pytest.raises(BagError, match="nothing matches s3://"):
        expand_bags([Path(f"s3://{bucket.name}/*/none_*.mcap")])
    with pytest.raises(BagError, match="there is no bag s3://"):
        expand_bags([Path(f"s3://{bucket.name}/none.mcap")])


def test_a_path_keeps_its_entry_on_the_way_to_another_process(tmp_path: Path) -> None:
    drive(tmp_path / "d.mcap", samples=10)
    with web_server(tmp_path) as url:
        path = remote(f"{url}/d.mcap", patience=3.0)
        assert path.entry.size == (tmp_path / "d.mcap").stat().st_size
    again = pickle.loads(pickle.dumps(path))
    assert (again, again.entry, again.patience) == (path, path.entry, 3.0)


def test_local_files_and_urls_are_told_apart(tmp_path: Path) -> None:
    assert type(place("/a/b.mcap")) is type(Path("x"))
    assert is_url(Path("s3://bucket/key"))
    assert not is_url(tmp_path)
    path = remote("s3://bucket/a/b.mcap")
    assert (str(path), path.name, str(path.parent)) == (
        "s3://bucket/a/b.mcap",
        "b.mcap",
        "s3://bucket/a",
    )


@pytest.mark.parametrize(
    "url",
    [
        "https://host/d.mcap?X-Amz-Signature=secret",
        "https://user:secret@host/d.mcap",
        "https://user:secret@host/d.mcap?secret",
        "https://host/d.mcap#token=secret",
        "s3://bucket/d.mcap?X-Amz-Signature=secret",
        " s3://key:secret@bucket/d.mcap",
    ],
)
def test_a_url_with_a_secret_is_refused_without_repeating_it(url: str) -> None:
    with pytest.raises(BagError) as refusal:
        place(url)
    assert "secret" not in str(refusal.value).replace("may hold a secret", "")


def test_an_error_tells_no_secret_of_a_redirection_or_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "hidden-in-the-environment")
    drive(tmp_path / "d.mcap", samples=10)
    with web_server(tmp_path, lambda *_: 403) as other:
        there = other.replace("http://", "http://user:pass-word@")
        place_of = f"{there}/d.mcap?X-Amz-Signature=abcdef&key=hidden-in-the-environment"
        with (
            web_server(tmp_path, lambda *_: 302, moved=place_of) as url,
            pytest.raises(BagError, match=r"storage did not deliver: .*403") as refusal,
        ):
            remote(f"{url}/d.mcap").read_range(0, 10)
    for secret in ("abcdef", "hidden-in", "pass-word"):
        assert secret not in str(refusal.value)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["http", "s3"])
def test_a_server_that_never_answers_is_given_up_after_the_patience(
    protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked for ranges, for what a file is, and for what a pattern means."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        for key in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_DEFAULT_REGION"):
            monkeypatch.setenv(key, "silent")
        monkeypatch.setenv("AWS_ENDPOINT_URL", url)
        begin = url if protocol == "http" else "s3://silent"
        known = remote(f"{begin}/d.mcap", patience=1.0)
        known._entry = Entry(1000, False, "")
        for ask in (
            lambda: known.read_range(0, 10),
            lambda: remote(f"{begin}/d.mcap", patience=1.0).entry,
            lambda: expand_bags([remote(f"{begin}/folder/*.mcap", patience=1.0)]),
        ):
            with pytest.raises(BagError, match=r"did not deliver|does not list"):
                ask()


def test_credentials_of_a_profile_do_as_those_of_the_environment(
    bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = bucket.put(drive(tmp_path / "d.mcap", samples=10), "d.mcap")
    profile = "[robots]\naws_access_key_id = test\naws_secret_access_key = test\n"
    (tmp_path / "credentials").write_text(profile)
    for key in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(key)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))
    monkeypatch.setenv("AWS_PROFILE", "robots")
    assert len(read_signals(remote(url, patience=5.0), [SPEED])[SPEED]) == 10


@pytest.mark.parametrize("protocol", ["http", "s3"])
@pytest.mark.parametrize(
    ("statuses", "said"),
    [
        ((503, 503), ""),
        ((200,), ""),  # half an answer
        ((503,) * 99, "storage did not deliver: .*503"),
        ((403,), "storage did not deliver: .*403"),
        ((404,), "bucket/d.mcap is not there"),
    ],
)
def test_ranges_are_asked_for_again_or_refused_at_once(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    protocol: str,
    statuses: tuple[int, ...],
    said: str,
) -> None:
    local = drive(tmp_path / "bucket" / "d.mcap", samples=10)
    asked = []

    def fault(path: str, number: int) -> int | None:
        asked.append(path)
        return statuses[number - 1] if number <= len(statuses) else None

    for key in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_DEFAULT_REGION"):
        monkeypatch.setenv(key, "test")
    with web_server(tmp_path, fault) as url:
        monkeypatch.setenv("AWS_ENDPOINT_URL", url)
        begin = url if protocol == "http" else "s3:/"
        path = remote(f"{begin}/bucket/d.mcap", patience=1.0 if said else 60.0)
        path._entry = remote(f"{url}/bucket/d.mcap").entry
        if not said:
            assert path.read_range(10, 500) == local.read_bytes()[10:500]
            assert len(asked) == 1 + len(statuses)
            return
        with pytest.raises((BagError, OSError), match=said):
            path.read_range(10, 500)
        assert (len(asked) == 1) == (statuses[0] != 503)


def test_an_object_that_vanishes_is_no_bag(bucket: Bucket, tmp_path: Path) -> None:
    path = remote(bucket.put(drive(tmp_path / "d.mcap"), "d.mcap"))
    assert path.entry.size
    bucket.remove("d.mcap")
    with pytest.raises(FileNotFoundError):
        read_signals(path, [SPEED])


def test_a_truncated_remote_file_is_refused_by_name(bucket: Bucket, tmp_path: Path) -> None:
    whole = drive(tmp_path / "d.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    url = bucket.put(tmp_path / "cut.mcap", "cut.mcap")
    with pytest.raises(BagError, match=rf"{url} is truncated or unfinished"):
        read_signals(url, [SPEED])
    with Bag(url, unfinished=True) as bag:
        assert 0 < bag.count(ODOM) < 200


def test_a_file_without_a_summary_is_read_whole(bucket: Bucket, tmp_path: Path) -> None:
    from mcap.data_stream import RecordBuilder
    from mcap.records import Footer

    whole = drive(tmp_path / "d.mcap").read_bytes()
    stated = int.from_bytes(whole[-28:-20], "little")
    builder = RecordBuilder()
    Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(builder)
    footer: bytes = builder.end()  # type: ignore[no-untyped-call]
    (tmp_path / "bare.mcap").write_bytes(whole[:stated] + footer + whole[-8:])
    url = bucket.put(tmp_path / "bare.mcap", "bare.mcap")
    found = read_signals(url, [SPEED])
    np.testing.assert_array_equal(
        found[SPEED].values, read_signals(tmp_path / "d.mcap", [SPEED])[SPEED].values
    )


@pytest.mark.parametrize("changes", [20, pytest.param(500, marks=pytest.mark.slow)])
def test_any_changed_byte_gives_the_same_signals_or_an_error(tmp_path: Path, changes: int) -> None:
    """Untrusted files: nothing but a BagError, and no other numbers from a compressed one."""
    content = drive(
        tmp_path / "d.mcap", samples=30, writer={"compression": CompressionType.LZ4}
    ).read_bytes()
    wanted = read_signals(tmp_path / "d.mcap", [SPEED])[SPEED].values
    rng = np.random.default_rng(1)
    refused = 0
    summary = int.from_bytes(content[-28:-20], "little")
    with web_server(tmp_path) as url:
        for k in range(changes):
            changed = bytearray(content)
            start = 0 if k % 2 else summary
            changed[int(rng.integers(start, len(content)))] ^= int(rng.integers(1, 256))
            (tmp_path / f"{k}.mcap").write_bytes(changed)
            try:
                found = read_signals(remote(f"{url}/{k}.mcap"), [SPEED])[SPEED].values
            except BagError as error:
                assert f"{url}/{k}.mcap" in str(error)  # noqa: PT017
                refused += 1
            else:
                np.testing.assert_array_equal(found, wanted)
    assert refused > changes / 3


def test_a_bag_of_sqlite_is_refused_in_storage(bucket: Bucket, tmp_path: Path) -> None:
    (tmp_path / "x.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(BagError, match="only MCAP is read from where it lies"):
        Bag(bucket.put(tmp_path / "x.db3", "x.db3"))


@pytest.mark.parametrize("said", [2**32, 2**63])
def test_a_chunk_that_says_it_is_huge_is_refused_before_it_is_fetched(
    tmp_path: Path, said: int
) -> None:
    content = bytearray(drive(tmp_path / "d.mcap", image_bytes=1000).read_bytes())
    summary = int.from_bytes(content[-28:-20], "little")
    for opcode, _, end in walk_records(bytes(content[summary:-8])):
        if opcode == Opcode.CHUNK_INDEX:
            content[summary + end - 8 : summary + end] = said.to_bytes(8, "little")
    content[-12:-8] = bytes(4)  # no checksum
    (tmp_path / "d.mcap").write_bytes(content)
    with web_server(tmp_path) as url:
        path = remote(f"{url}/d.mcap", patience=5.0)
        with pytest.raises(BagError, match=f"without compression, and says {said}"):
            read_signals(path, WANTED)
        assert path.fetched < 2**15


def test_chunks_that_are_listed_in_any_order_are_read_in_theirs_and_each_once(
    tmp_path: Path,
) -> None:
    local = drive(tmp_path / "d.mcap", image_bytes=3000)
    content = bytearray(local.read_bytes())
    content[-12:-8] = bytes(4)  # without the summary's checksum
    summary = int.from_bytes(content[-28:-20], "little")
    listed = [
        content[summary + start : summary + end]
        for opcode, start, end in walk_records(bytes(content[summary:-8]))
        if opcode == Opcode.CHUNK_INDEX
    ]
    assert len(listed) > 4
    start = content.index(b"".join(listed), summary)
    end = start + len(b"".join(listed))
    content[start:end] = b"".join(reversed(listed))
    (tmp_path / "reversed.mcap").write_bytes(content)
    assert len(listed[1]) == len(listed[2])
    content[start:end] = b"".join([listed[0], listed[1], listed[1], *listed[3:]])
    (tmp_path / "twice.mcap").write_bytes(content)
    with web_server(tmp_path) as url:
        found = read_signals(f"{url}/reversed.mcap", WANTED)
        twice = read_signals(f"{url}/twice.mcap", WANTED)  # which is walked
    for text, samples in read_signals(local, WANTED).items():
        np.testing.assert_array_equal(found[text].values, samples.values)
        np.testing.assert_array_equal(found[text].stamp_ns, samples.stamp_ns)
        np.testing.assert_array_equal(twice[text].stamp_ns, samples.stamp_ns)


def test_a_message_that_says_it_is_longer_than_its_record_is_refused(tmp_path: Path) -> None:
    """It would be made of what was fetched behind it."""
    local = drive(tmp_path / "d.mcap", image_bytes=30_000, samples=20)
    with closing(McapFile(local)) as file:
        block = file.contents.blocks[0]
        command = next(c.id for c in file.contents.declared.channels.values() if c.topic == CMD)
        record = file._read(*(block.index or {})[command])
        at = block.offset + int(index_offsets(record, command, "")[0])
    content = bytearray(local.read_bytes())
    length = int.from_bytes(content[at + 1 : at + 9], "little")
    content[at + 1 : at + 9] = (length + 1).to_bytes(8, "little")
    local.write_bytes(content)
    with (
        web_server(tmp_path) as url,
        pytest.raises(BagError, match="messages that overlap"),
    ):
        read_signals(remote(f"{url}/d.mcap"), [COMMAND])


def test_a_huge_file_without_a_summary_is_refused_before_it_is_fetched(tmp_path: Path) -> None:
    """A gigabyte of zeros, of which the disk holds nothing; and one that says it is so long."""
    with (tmp_path / "huge.mcap").open("wb") as stream:
        stream.truncate(2**30)
    whole = drive(tmp_path / "d.mcap", samples=10).read_bytes()
    start = int.from_bytes(whole[-28:-20], "little")
    (tmp_path / "far.mcap").write_bytes(
        whole[:-28] + (start + 2**40).to_bytes(8, "little") + whole[-20:]
    )
    with web_server(tmp_path) as url:
        for name, reason in (
            ("huge", "1073741824 bytes and no summary"),
            ("far", "summary offset is damaged"),
        ):
            path = remote(f"{url}/{name}.mcap")
            with pytest.raises(BagError, match=reason):
                read_signals(path, [SPEED])
            assert path.fetched < 2**15
