"""`nlsid fleet check` and `nlsid fleet monitor`: a row a bag, and what the rows say together."""

import math
import os
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from bags.chain.config import load_config
from bags.chain.steps import check_split
from bags.commands import fleet_cli
from bags.commands.cli import app
from bags.designs import documents
from bags.fleet.bags import named_bags
from bags.fleet.check import CheckBag
from bags.fleet.monitor import FleetVerdict, JudgeBag, judged_of
from bags.fleet.rows import Row, read_rows
from bags.fleet.trials import read_fleet
from bags.fleet.workers import Workers
from bags.monitoring.replay import replay_bag
from bags.recordings.remote import MARK_BYTES
from bags.samples import f1tenth
from nlsid_core.errors import DataError
from nlsid_core.running.comparison import Centre
from tests.bag_messages import START_NS
from tests.bags.fleet.storage import Odd, drive, web_server
from tests.marks import slow_among
from tests.verbs import nlsid

CONFIG = Path("config/f1tenth.yaml")


def held_against(funnel: Path, bags: Mapping[str, Path]) -> FleetVerdict:
    """The bags of a fleet, judged in this process."""
    design = documents.load(funnel)
    read = read_rows(JudgeBag(design, Centre.COMMAND, {}), bags, workers=Workers())
    return FleetVerdict(read, frozenset(design.made_with))


def checked(bags: Mapping[str, Path]) -> tuple[Row, ...]:
    """Whether the bags are fit for F1TENTH's configuration."""
    return read_rows(CheckBag(load_config(CONFIG)), bags, workers=Workers())


def test_a_fleet_is_judged_bag_by_bag_as_one_bag_is(funnel: Path) -> None:
    proved = documents.load(funnel)
    bags = {path.name: path for path in f1tenth()[:6]}
    found = held_against(funnel, bags)
    for row, path in zip(found.rows, bags.values(), strict=True):
        alone = replay_bag(proved, path, centre=Centre.COMMAND)
        assert alone.worst is not None
        assert row.verdict == alone.verdict
        assert row.numbers["margin"] == alone.worst.margin
        assert row.numbers["span"] == alone.span
        most = max(alone.judged, key=lambda reading: reading.assumption)
        assert row.numbers["spent"] == most.assumption
        assert row.numbers["spent_at"] == most.t
        start = datetime.fromtimestamp(alone.stamps_ns[0] // 10**9, UTC)
        assert row.start == start.isoformat()
    worse = replace(alone, readings=(*alone.judged, alone.judged[0]._replace(assumption=math.inf)))
    assert judged_of(worse, path, "worse").numbers["spent"] == 1e300, "it is not left out"


@pytest.mark.slow
def test_bags_that_made_the_design_are_not_counted_for_the_next(funnel: Path) -> None:
    bags = {path.name: path for path in f1tenth()}
    found = held_against(funnel, bags)
    assert {row.bag for row in found.others} == set(load_config(CONFIG).split.test)
    assert "probability 1/9 = 0.112 at most" in found.ranks[0]


def test_ranks_of_a_thousand_bags_say_two_things() -> None:
    rows = tuple(Row(f"{k}", "inside", numbers={"spent": k / 1000}) for k in range(1000))
    first, second = FleetVerdict(rows, frozenset()).ranks
    assert "more than 99.9 % of what is assumed with probability 1/1001 = 0.001 at most" in first
    assert "more than 99 % of what is assumed with probability 10/1001 = 0.01 at most" in second


def test_the_command_says_who_was_outside_and_that_one_was_not_read(
    funnel: Path, tmp_path: Path
) -> None:
    drive(tmp_path / "fleet" / "robot_1" / "other.mcap", samples=117)
    (tmp_path / "fleet" / "robot_2").mkdir()
    (tmp_path / "fleet" / "robot_2" / "cut.mcap").write_bytes(b"no bag")
    pattern = str(tmp_path / "fleet" / "*" / "*.mcap")
    table, kept = tmp_path / "rows.parquet", tmp_path / "rows.sqlite"
    given = ["--out", str(table), "--manifest", str(kept)]
    said = nlsid("fleet", "monitor", funnel.parent, pattern, *given, status=1)
    assert "robot_2/cut: " in said
    worst = tmp_path / "fleet" / "robot_1" / "other.mcap"
    assert f"nlsid view {funnel.parent} {worst}" in said
    assert "is no MCAP, SQLite or ROS 1 file" in said
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = {row["bag"]: row for row in parquet.read_table(table).to_pylist()}
    assert set(rows) == {"robot_1/other", "robot_2/cut"}
    assert rows["robot_1/other"]["verdict"] in ("outside", "assumption violated")
    assert rows["robot_2/cut"]["verdict"] == "not read"
    assert kept.exists()


def test_a_recording_that_two_bags_have_is_counted_once(funnel: Path, tmp_path: Path) -> None:
    """Byte for byte, and with other bytes but the same messages."""
    original = drive(tmp_path / "a" / "drive.mcap", samples=117)
    for folder in "bc":
        (tmp_path / folder).mkdir()
    (tmp_path / "b" / "drive.mcap").write_bytes(original.read_bytes())
    drive(tmp_path / "c" / "drive.mcap", samples=117, writer={"chunk_size": 2**20})
    found = held_against(funnel, named_bags([tmp_path / "*" / "*.mcap"]))
    assert [row.verdict for row in found.rows][1:] == ["copy", "copy"]
    assert [row.reason for row in found.rows][1:] == 2 * ["the same recording as a/drive"]
    assert [row.bag for row in found.others] == ["a/drive"]


def test_bags_of_the_design_that_are_not_recognised_are_said(
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = tuple(Row(name, "inside", marks=(name,), numbers={"spent": 0.5}) for name in "ab")
    for made_of, is_said in (("xy", True), ("bx", False), ("", False)):
        fleet_cli._say_verdicts(FleetVerdict(rows, frozenset(made_of)))
        assert ("none of these is known" in capsys.readouterr().out) is is_said


def test_what_a_web_server_tells_of_two_recordings_may_be_the_same(
    funnel: Path, tmp_path: Path
) -> None:
    """Size, time of change, tag and end of the file: a copy is what has the same samples."""
    pytest.importorskip("obstore")
    web = tmp_path / "web"
    for name, seed in (("a", 1), ("b", 2), ("c", 1)):
        os.utime(
            drive(web / f"{name}.mcap", samples=400, seed=seed, writer={"chunk_size": 2**12}),
            ns=(10**18, 10**18),
        )
    tails = {file.name: file.read_bytes()[-MARK_BYTES:] for file in web.iterdir()}
    assert tails["a.mcap"] == tails["b.mcap"]
    with web_server(web) as url:
        found = held_against(funnel, named_bags([Path(f"{url}/{name}.mcap") for name in "abc"]))
    rows = {row.bag: row for row in found.rows}
    assert rows["b"].numbers["judged"] > 0
    assert "copy" not in (rows["a"].verdict, rows["b"].verdict)
    assert (rows["c"].verdict, rows["c"].reason) == ("copy", "the same recording as a")


def test_names_of_objects_cannot_write_to_the_terminal(funnel: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet" / "robot[red]"
    drive(fleet / "a[bold][/red]\x1b[2J.mcap", samples=117)
    (fleet / "b[").mkdir()  # the rest of the name is after a slash
    (fleet / "b[/bold].mcap").write_bytes(b"no bag")
    where = [str(funnel.parent), str(fleet)]
    check, monitor = ["check", *where, "--config", str(CONFIG)], ["monitor", *where]
    for given in (check, monitor):
        said = nlsid("fleet", *given, status=2)  # one was not read
        assert "a[bold][" in said
        assert "red]\N{REPLACEMENT CHARACTER}[2J" in said
        assert "b[/bold].mcap" in said
        assert "\x1b[2J" not in said


def test_a_command_that_one_bag_holds_does_not_make_it_bad() -> None:
    """Each of the shipped trials 6 to 11 does so, and they are identified from."""
    bags = {path.name: path for path in f1tenth()[5:7]}
    rows = checked(bags)
    assert [row.verdict for row in rows] == ["good", "good"]
    assert all("no excitation" in row.said["findings"] for row in rows)
    assert all(row.start.startswith("2022-01-01T00:") for row in rows)


@pytest.fixture(scope="module")
def spoiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight bags of four robots and three days, and one of each kind of spoiled ones."""
    folder = tmp_path_factory.mktemp("spoiled")
    for k in range(8):
        start_ns = START_NS + (k % 3) * 86_400 * 10**9
        file = folder / f"r{k % 4}" / "2022-01" / f"d{k:02d}.mcap"
        drive(file, samples=60, seed=k, odd=Odd(start_ns=start_ns))
    own = folder / "r9" / "2022-01"
    whole = drive(own / "cut.mcap", samples=60, seed=50).read_bytes()
    (own / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    (own / "empty.mcap").write_bytes(b"")
    drive(own / "gap.mcap", samples=60, seed=51, odd=Odd(without=range(30, 45)))
    drive(own / "back.mcap", samples=60, seed=52, odd=Odd(back_from=30))
    drive(own / "still.mcap", samples=60, seed=53, odd=Odd(held=0.25))
    drive(own / "other.mcap", samples=60, seed=54, odd=Odd(odom="/wheels"))
    (own / "copy.mcap").write_bytes((folder / "r1" / "2022-01" / "d01.mcap").read_bytes())
    return folder


def fleet_command(verb: str, *given: object, status: int = 0, columns: int = 80) -> list[str]:
    return nlsid("fleet", verb, *given, status=status, columns=columns).splitlines()


@pytest.mark.parametrize("columns", [80, 140])
def test_check_puts_first_what_the_next_step_refuses(spoiled: Path, columns: int) -> None:
    given = ("DIR", str(spoiled / "*" / "*" / "*.mcap"), "--config", str(CONFIG))
    lines = fleet_command("check", *given, status=1, columns=columns)
    assert lines[0] == "15 bags: 3 not read, 2 bad, 1 copy, 0 look, 9 good"
    shown = [line.split()[:3] for line in lines if line.startswith("r")]
    assert [" ".join(words).replace("not read", "unread").split()[:2] for words in shown] == [
        ["r9/2022-01/cut", "unread"],
        ["r9/2022-01/empty", "unread"],
        ["r9/2022-01/other", "unread"],
        ["r9/2022-01/back", "bad"],
        ["r9/2022-01/gap", "bad"],
        ["r9/2022-01/copy", "copy"],
    ]
    assert all(len(line) <= columns for line in lines)
    said = " ".join(" ".join(lines).split())
    assert "truncated or unfinished" in said
    assert "lost" not in lines[1]
    if columns == 140:
        assert "`nlsid identify` leaves it out: /odom: time goes back by" in said
        assert "a gap of 0.4 s after sample 29" in said


def test_check_says_that_every_bag_it_calls_bad_is_one_that_identify_leaves_out(
    spoiled: Path, tmp_path: Path
) -> None:
    bags, config = named_bags([spoiled / "*" / "*" / "*.mcap"]), load_config(CONFIG)
    split = config.split.model_copy(update={"test": ["r0/*"], "calibration": []})
    config = config.model_copy(update={"split": split})
    rows = read_rows(CheckBag(config), bags, workers=Workers())
    listed = {row.bag: row.reason for row in rows if row.verdict in ("not read", "bad", "copy")}
    left_out = read_fleet(bags, config, tmp_path, workers=Workers()).left_out
    assert listed.keys() == left_out.keys()
    assert all(listed[name].endswith(reason) for name, reason in left_out.items())


def test_monitor_counts_as_check_does_and_lists_all_that_is_not_inside(
    spoiled: Path, funnel: Path, tmp_path: Path
) -> None:
    pattern, kept = str(spoiled / "*" / "*" / "*.mcap"), str(tmp_path / "kept.sqlite")
    given = (str(funnel.parent), pattern, "--manifest", kept)
    lines = fleet_command("monitor", *given, status=1)
    said = "\n".join(lines)
    assert re.match(r"15 bags: .*3 not read, 1 copy", lines[0])
    assert f"0 of them known from {kept}, 15 asked of now" in lines[1]
    for name in ("cut", "empty", "other", "copy", "back", "gap"):
        assert f"  r9/2022-01/{name}: " in said
    assert re.search(
        r"r9/2022-01/back: \d+ samples from \d.* s: time went back by .* on /odom", said
    )
    worst = lines.index("the 10 bags that spent the most, and when:")
    assert [len(line) <= 80 for line in lines[worst : worst + 13]] == 13 * [True]
    assert "\N{HORIZONTAL ELLIPSIS}" not in said, "nothing is cut"
    again = fleet_command("monitor", *given, status=1)
    assert f"12 of them known from {kept}, 3 asked of now" in again[1]
    assert [lines[0], *lines[2:]] == [again[0], *again[2:]]


def test_a_fleet_in_which_no_command_moves_is_said(tmp_path: Path) -> None:
    for k in range(2):
        drive(tmp_path / f"d{k}.mcap", samples=60, seed=k, odd=Odd(held=0.25))
    lines = fleet_command("check", "DIR", tmp_path, "--config", CONFIG)
    assert lines == [
        "2 bags: 0 not read, 0 bad, 0 copies, 0 look, 2 good",
        "no command moves in any bag that can be used: there is little to identify from",
    ]


def test_messages_that_a_recorder_lost_are_a_column_where_they_were_counted(
    tmp_path: Path,
) -> None:
    for k, lost in enumerate((3, 0, None)):
        drive(tmp_path / f"d{k}.mcap", samples=60, seed=k, odd=Odd(lost=lost))
    lines = fleet_command("check", "DIR", tmp_path, "--config", CONFIG)
    assert lines[0] == "3 bags: 0 not read, 0 bad, 0 copies, 1 look, 2 good"
    assert lines[1].split() == [
        "bag",
        "verdict",
        "start",
        "(UTC)",
        "lost",
        "what",
        "to",
        "look",
        "at",
    ]
    assert re.fullmatch(r"d0 +look +2\S+ \S+ +3 its recorder lost 3 messages *", lines[3])


def identified_with(test: list[str], bags: Path, folder: Path, reason: str) -> str:
    """What `identify` prints of bags read by workers, of which these are test trials."""
    content = yaml.safe_load(CONFIG.read_text())
    content["split"] = {"test": test}
    config = folder / "robot.yaml"
    config.write_text(yaml.safe_dump(content))
    given = ["identify", str(folder / "out"), str(bags), "--config", str(config), "--workers", "1"]
    done = CliRunner().invoke(app, given)
    assert isinstance(done.exception, DataError)
    assert re.search(reason, str(done.exception))
    return done.output


def test_an_identification_that_fails_says_first_what_was_read(tmp_path: Path) -> None:
    """The one bag that is no test trial cannot be read, so nothing is left to train on."""
    drive(tmp_path / "bags" / "drive.mcap", samples=60)
    (tmp_path / "bags" / "cut.mcap").write_bytes(b"no bag")
    said = identified_with(
        ["drive"], tmp_path / "bags", tmp_path, "all of the bags are test trials"
    )
    lines = said.splitlines()
    assert lines[0].startswith("2 bags: 1 used; 0 of them known")
    assert lines[1:3] == [
        "left out: 1 bag",
        "  cut: is damaged or not a bag: it is no MCAP, SQLite or ROS 1 file: "
        "it starts with 6e 6f 20 62 61 67. `nlsid bag import` makes a bag of a table",
    ]


@pytest.mark.parametrize(
    ("test", "reason"),
    [
        (["elsewhere"], "split.test names elsewhere; the bags are drive_1, drive_2"),
        (["drive_?"], "all of the bags are test"),
    ],
)
def test_names_that_cannot_be_split_are_refused_before_a_bag_is_read(
    tmp_path: Path, test: list[str], reason: str
) -> None:
    """Neither bag is one, and none is said to be unreadable."""
    for k in (1, 2):
        (tmp_path / f"drive_{k}.mcap").write_bytes(b"no bag")
    assert identified_with(test, tmp_path, tmp_path, reason) == ""
    assert not (tmp_path / "out" / "fleet.sqlite").exists()


def test_a_part_of_a_bag_with_gaps_may_be_named_before_it_is_known() -> None:
    """Only reading tells whether `drive` has one."""
    config = load_config(CONFIG)
    split = config.split.model_copy(update={"test": ["drive.2"], "calibration": []})
    check_split(["drive"], config.model_copy(update={"split": split}))


@pytest.mark.parametrize("verb", slow_among(["check", "monitor"], {"monitor"}))
def test_storage_that_fails_is_listed_once_and_the_rest_is_judged(
    funnel: Path, tmp_path: Path, verb: str
) -> None:
    """Cut off, busy for ever, busy for a while, vanished, too slow: each with its reason."""
    pytest.importorskip("obstore")
    web = tmp_path / "web"
    for seed, name in enumerate(("cut", "busy", "late", "gone", "slow", "good")):
        drive(web / f"{name}.mcap", samples=117, seed=seed)
    content = (web / "cut.mcap").read_bytes()
    (web / "cut.mcap").write_bytes(content[: len(content) // 2])
    asked: Counter[str] = Counter()

    def fault(path: str, number: int) -> int | None:
        asked[path] += 1
        answers = {"/busy.mcap": 503, "/gone.mcap": 404}
        return 503 if path == "/late.mcap" and number <= 2 else answers.get(path)

    with web_server(web, fault, bytes_per_s={"/slow.mcap": 2000.0}) as url:
        named = named_bags([Path(f"{url}/{file.name}") for file in web.iterdir()], patience=4.0)
        found = checked(named) if verb == "check" else held_against(funnel, named).rows
    rows = {row.bag: row for row in found}
    assert [row.bag for row in found] == sorted(rows) == sorted(named)
    said = {name: f"{row.reason} {row.said}" for name, row in rows.items()}
    assert re.search("truncated or unfinished|unfinished: ", said["cut"])
    assert [rows[name].verdict for name in ("busy", "slow", "gone")] == 3 * ["not read"]
    assert "storage did not deliver" in said["busy"]
    assert "storage did not deliver" in said["slow"]
    assert "not there any more" in said["gone"]
    assert not {rows[name].verdict for name in ("late", "good")} & {"bad", "not read"}
    assert asked["/late.mcap"] > 2
