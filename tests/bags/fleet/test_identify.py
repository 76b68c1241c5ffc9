"""Many bags give what one machine's run gives, whoever reads them, and a bad one ends nothing."""

import json
import signal
import sqlite3
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from bags.chain.config import Config, load_config
from bags.chain.steps import identify_bags, identify_trials
from bags.designs import documents
from bags.fleet.bags import Recordings, named_bags
from bags.fleet.check import CheckBag
from bags.fleet.manifest import Manifest
from bags.fleet.run import ask
from bags.fleet.trials import MANIFEST, FleetTrials, ReadTrials, read_fleet
from bags.fleet.workers import Workers
from bags.recordings.definitions import standard_definition
from bags.samples import f1tenth
from nlsid_core.errors import BagError, DataError
from nlsid_core.progress import silent
from tests.bag_messages import CMD, CMD_TYPE, ODOM
from tests.bags.fleet.conftest import Bucket
from tests.bags.fleet.deadly import Deadly
from tests.bags.fleet.storage import drive, web_server
from tests.mcap_files import write_mcap

CONFIG = """\
robot: car
signals:
  response: {name: speed, unit: m/s, path: "/odom:twist.twist.linear.x"}
  excitation: {name: command, unit: m/s, path: "/cmd_vel:twist.linear.x"}
grid: {period: 0.025, max_gap: 0.1}
split: {test: ["*_0"]}
identification: {lags: 2, iterations: 1}
"""
FILES = (documents.MODEL, documents.MODEL_PROOF, documents.TRIALS)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    file = tmp_path / "robot.yaml"
    file.write_text(CONFIG)
    return file


def fleet(folder: Path, count: int = 6) -> Path:
    for k in range(count):
        drive(folder / f"robot_{k % 2}" / f"drive_{k}.mcap", seed=k, samples=120)
    return folder


def run(
    bags: Path,
    config: Path,
    out: Path,
    workers: Workers = Workers(),  # noqa: B008
) -> FleetTrials:
    return identified(named_bags([bags]), load_config(config), out, workers)


def identified(
    bags: Mapping[str, Path],
    config: Config,
    out: Path,
    workers: Workers = Workers(),  # noqa: B008
) -> FleetTrials:
    """What was read; the model of it is in `out`."""
    found = read_fleet(bags, config, out, workers=workers)
    identify_trials(found.trials, config, out, progress=silent)
    return found


def contents(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in FILES]


def test_names_follow_the_pattern_and_stay_when_others_come(tmp_path: Path) -> None:
    folder = fleet(tmp_path / "fleet", 3)
    for pattern, names in {
        "*/drive_*.mcap": ["robot_0/drive_0", "robot_0/drive_2", "robot_1/drive_1"],
        "robot_*/*_1.mcap": ["robot_1/drive_1"],
        "robot_0": ["drive_0", "drive_2"],
        "robot_0/drive_2.mcap": ["drive_2"],
    }.items():
        assert list(named_bags([folder / pattern])) == names
    with pytest.raises(DataError, match="two bags are called 'drive_0'"):
        named_bags([folder / "robot_0", drive(tmp_path / "drive_0.mcap")])


def test_a_folder_whose_folders_hold_bags_says_the_pattern(tmp_path: Path) -> None:
    fleet(tmp_path / "cars", 4)
    (tmp_path / "cars" / "empty").mkdir()
    with pytest.raises(BagError, match=r"give a pattern, '.*/\*/\*', in quotes"):
        named_bags([tmp_path / "cars"])
    with pytest.raises(BagError, match=r"holds none \(no .mcap or .db3 or .bag\)"):
        named_bags([tmp_path / "cars" / "empty"])
    assert len(named_bags([tmp_path / "cars" / "*" / "*.mcap"])) == 4


def test_a_recording_is_known_by_any_of_its_marks_and_named_by_who_had_it_first() -> None:
    known = Recordings()
    for name, marks, first in (
        ("a", ["digest a", "samples 1"], "a"),
        ("b", ["digest b", "samples 1"], "a"),
        ("c", ["digest b"], "a"),
        ("d", ["digest d"], "d"),
    ):
        assert known.first(name, marks) == first


@pytest.mark.slow
def test_the_result_is_the_same_to_the_bit_whoever_reads(tmp_path: Path, config: Path) -> None:
    distributed = pytest.importorskip("distributed")
    pattern = fleet(tmp_path / "fleet") / "*" / "*.mcap"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        readers = (Workers(), Workers(2), Workers(scheduler=cluster.scheduler_address))
        for k, workers in enumerate(readers):
            run(pattern, config, tmp_path / f"out_{k}", workers)
    first, *others = (contents(tmp_path / f"out_{k}") for k in range(len(readers)))
    assert others == [first, first]
    with pytest.raises(DataError, match="name one of them"):
        Workers(2, "tcp://host:1")


@pytest.mark.slow
def test_a_fleet_of_one_folder_gives_what_identify_gives(tmp_path: Path) -> None:
    config = load_config(Path("config/f1tenth.yaml"))
    bags = f1tenth()
    identify_bags(bags, config, tmp_path / "alone", progress=silent)
    identified({path.name: path for path in bags}, config, tmp_path / "fleet")
    assert contents(tmp_path / "alone") == contents(tmp_path / "fleet")


@pytest.mark.slow
def test_storage_gives_the_same_numbers_and_digests_of_its_own(
    tmp_path: Path, config: Path, bucket: Bucket
) -> None:
    folder = fleet(tmp_path / "fleet", 4)
    for file in folder.glob("*/*.mcap"):
        bucket.put(file, str(file.relative_to(folder)))
    here = run(folder / "*" / "*.mcap", config, tmp_path / "here")
    there = run(Path(f"s3://{bucket.name}/*/*.mcap"), config, tmp_path / "there", Workers(1))
    models = [
        json.loads((tmp_path / out / documents.MODEL).read_text())["a"] for out in ("here", "there")
    ]
    assert models[0] == models[1]
    digests = [[trial.digest for trial in found.trials.train] for found in (here, there)]
    assert not set(digests[0]) & set(digests[1])


def test_a_bad_bag_is_listed_by_name_and_reason(tmp_path: Path, config: Path) -> None:
    folder = fleet(tmp_path / "fleet")
    good = (folder / "robot_0" / "drive_2.mcap").read_bytes()
    (folder / "robot_0" / "cut.mcap").write_bytes(good[: len(good) // 2])
    (folder / "robot_0" / "text.mcap").write_bytes(b"no bag")
    (folder / "robot_1" / "copy.mcap").write_bytes(good)
    text = standard_definition(CMD_TYPE).text
    write_mcap(folder / "robot_1" / "other.mcap", dict.fromkeys((ODOM, CMD), (CMD_TYPE, text)))
    found = run(folder / "*" / "*.mcap", config, tmp_path / "out")
    assert set(found.left_out) == {
        f"robot_{name}" for name in ("0/cut", "0/text", "1/copy", "1/other")
    }
    assert "truncated or unfinished" in found.left_out["robot_0/cut"]
    assert "is no MCAP, SQLite or ROS 1 file" in found.left_out["robot_0/text"]
    assert "twist.twist" in found.left_out["robot_1/other"]
    assert found.left_out["robot_1/copy"] == "the same recording as robot_0/drive_2"
    assert len(found.trials.train) + len(found.trials.test) == 6


def test_a_second_run_reads_only_what_is_new(tmp_path: Path, config: Path) -> None:
    folder = fleet(tmp_path / "fleet")
    pattern = folder / "*" / "*.mcap"
    run(pattern, config, tmp_path / "out")
    drive(folder / "robot_9" / "drive_9.mcap", seed=9, samples=120)
    drive(folder / "robot_0" / "drive_2.mcap", seed=10, samples=130)
    again = run(pattern, config, tmp_path / "out")
    assert {a.name for a in again.answers if not a.kept} == {"robot_9/drive_9", "robot_0/drive_2"}
    run(pattern, config, tmp_path / "fresh")
    assert contents(tmp_path / "out") == contents(tmp_path / "fresh")


def test_an_edited_definition_is_asked_again(tmp_path: Path, config: Path) -> None:
    given = tmp_path / "robot_msgs" / "msg" / "Speed.msg"
    given.parent.mkdir(parents=True)
    settings = load_config(config).model_copy(update={"definitions": (given,)})
    asked = []
    for text in ("float64 x", "float64 x", "float64 y"):
        given.write_text(f"std_msgs/Header header\n{text}\n")
        asked.append((ReadTrials(settings).asked, CheckBag(settings).asked))
    assert asked[0] == asked[1]
    assert all(old != new for old, new in zip(asked[0], asked[2], strict=True))


def test_what_is_no_manifest_is_refused(tmp_path: Path) -> None:
    (tmp_path / MANIFEST).write_bytes(b"x" * 5000)
    with pytest.raises(DataError, match="not a manifest of bags"):
        Manifest(tmp_path / MANIFEST)


def test_two_recordings_with_the_same_samples_are_one(tmp_path: Path, config: Path) -> None:
    """An object and its copy of another storage have other digests."""
    folder = fleet(tmp_path / "fleet", 3)
    drive(folder / "copied" / "drive.mcap", seed=2, samples=120, writer={"chunk_size": 2**20})
    found = read_fleet(
        named_bags([folder / "*" / "*.mcap"]), load_config(config), tmp_path, workers=Workers()
    )
    assert found.left_out == {"robot_0/drive_2": "the same recording as copied/drive"}


def test_a_bag_that_changes_while_it_is_read_is_named_and_not_kept(
    tmp_path: Path, config: Path
) -> None:
    """Chunks of one recording and the end of another would pass for a third."""
    pytest.importorskip("obstore")
    local = drive(tmp_path / "web" / "drive.mcap", samples=120, image_bytes=1000)
    other = drive(tmp_path / "other.mcap", seed=1, samples=120, image_bytes=1000)
    assert local.stat().st_size == other.stat().st_size
    swapped: list[int] = []

    def swap(_: str, number: int) -> None:
        if number == 2 and not swapped:
            swapped.append(number)
            local.write_bytes(other.read_bytes())

    task = ReadTrials(load_config(config))
    with web_server(tmp_path / "web", swap) as url, Manifest(tmp_path / MANIFEST) as manifest:
        first, second = (
            next(ask(task, named_bags([Path(f"{url}/drive.mcap")]), Workers(), manifest))
            for _ in range(2)
        )
    assert swapped
    assert first.reason == "it changed while it was read; start the command again"
    assert not second.reason
    assert not second.kept


def test_two_runs_may_share_a_manifest(tmp_path: Path) -> None:
    def write(k: int) -> None:
        with Manifest(tmp_path / MANIFEST) as manifest:
            for row in range(50):
                manifest.keep(f"{k} {row}", "bag", f"{k} {row}".encode())

    with ThreadPoolExecutor(4) as several:
        list(several.map(write, range(4)))
    with Manifest(tmp_path / MANIFEST) as manifest:
        for k in range(4):
            for row in range(50):
                assert manifest.find(f"{k} {row}") == f"{k} {row}".encode()


def test_a_manifest_that_cannot_be_used_is_not_to_be_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another run has it, or a row of it is none: never a verdict, and no loss of what is kept."""
    monkeypatch.setattr("bags.fleet.manifest.BUSY", 0.1)
    with Manifest(tmp_path / MANIFEST) as manifest:
        manifest.keep("a", "bag", b"content")
        with sqlite3.connect(tmp_path / MANIFEST, isolation_level=None) as other:
            other.execute("begin immediate")
            with pytest.raises(DataError, match=r"fleet\.sqlite cannot be used: .*locked"):
                manifest.keep("b", "bag", b"content")
            other.execute("update bags set content = 5")
            other.execute("commit")
        with pytest.raises(DataError, match="a row of this manifest"):
            manifest.find("a")


def test_what_is_answered_is_on_the_disk_and_not_in_memory(tmp_path: Path) -> None:
    class Long:
        asked = "long"

        def __call__(self, bag: Path, name: str) -> bytes:  # noqa: ARG002
            return name.encode() * 50_000

    (tmp_path / "bag").write_text("")
    bags = {f"{k:02d}": tmp_path / "bag" for k in range(60)}
    tracemalloc.start()
    try:
        with Manifest(None) as manifest:
            for name, answer in zip(bags, ask(Long(), bags, Workers(), manifest), strict=True):
                assert answer.content == name.encode() * 50_000
            _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1e6, "60 answers are 6 MB"


@pytest.mark.slow
@pytest.mark.parametrize(("count", "once"), [(1, "d"), (2, "e")])  # d: c dies, then d once itself
def test_the_death_of_a_worker_costs_at_most_the_bag_that_kills_it(
    tmp_path: Path, count: int, once: str
) -> None:
    bags = {}
    for name in "abcdef":
        bags[name] = tmp_path / name
        bags[name].write_text(name)
    with Manifest(tmp_path / MANIFEST) as manifest:
        answers = [*ask(Deadly(tmp_path, always="c", once=once), bags, Workers(count), manifest)]
    assert [a.name for a in answers] == list("abcdef")
    assert [a.name for a in answers if a.reason] == ["c"]
    assert answers[2].reason == "its worker died twice"
    assert [a.content.decode() for a in answers if not a.reason] == list("abdef")


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, config: Path) -> None:
    pattern = fleet(tmp_path / "fleet", 30) / "*" / "*.mcap"
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "bags.commands.main",
        "identify",
        str(out),
        str(pattern),
        "--config",
        str(config),
        "--workers",
        "1",
    ]
    started = subprocess.Popen(command)
    deadline = time.monotonic() + 60.0
    while _rows(out / MANIFEST) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    started.send_signal(signal.SIGKILL)
    started.wait()
    kept = _rows(out / MANIFEST)
    assert kept >= 3
    again = run(pattern, config, out)
    assert sum(answer.kept for answer in again.answers) >= kept
    run(pattern, config, tmp_path / "fresh")
    assert contents(out) == contents(tmp_path / "fresh")


def _rows(manifest: Path) -> int:
    if not manifest.exists():
        return 0
    try:
        with sqlite3.connect(manifest) as rows:
            return int(rows.execute("select count(*) from bags").fetchone()[0])
    except sqlite3.OperationalError:
        return 0


@pytest.mark.slow
def test_storage_that_fails_costs_the_bags_it_fails_for(tmp_path: Path, config: Path) -> None:
    """Busy for ever, vanished after it was listed, busy for a while: each once."""
    pytest.importorskip("obstore")
    for k in range(4):
        drive(tmp_path / "web" / f"drive_{k}.mcap", seed=k, samples=120)

    def fault(path: str, number: int) -> int | None:
        return {"/drive_1.mcap": 503, "/drive_2.mcap": 404}.get(path, 503 if number <= 2 else None)

    with web_server(tmp_path / "web", fault) as url:
        named = named_bags([Path(f"{url}/drive_{k}.mcap") for k in range(4)], patience=2.0)
        found = identified(named, load_config(config), tmp_path / "out")
    assert found.left_out.keys() == {"drive_1", "drive_2"}
    assert "storage did not deliver" in found.left_out["drive_1"]
    assert found.left_out["drive_2"] == "it is not there any more"
    assert {*found.trials.train.names, *found.trials.test.names} == {"drive_0", "drive_3"}
