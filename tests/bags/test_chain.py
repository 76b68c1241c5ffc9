"""The chain on the shipped F1TENTH bags, through the command line, with the promised figures."""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.chain.config import Config, load_config
from bags.chain.faults import FAULTS, write_faulty_copy
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags, read_trials
from bags.chain.training import load_trials, save_trials
from bags.commands.show import paced_lines, replay_lines, worth
from bags.designs import documents
from bags.designs.provenance import of_proof
from bags.monitoring.replay import Replay, replay_bag
from bags.recordings.bag import Bag
from bags.recordings.writer import BagWriter
from bags.signals.signal import SignalPath
from nlsid import Grid, Status, f1tenth, read_bags
from nlsid_core import files
from nlsid_core.errors import DataError
from nlsid_core.identification import simulation_percent
from nlsid_core.identification.prediction import simulate_started
from nlsid_core.progress import silent
from nlsid_core.running.comparison import Centre
from tests.bag_messages import put
from tests.verbs import nlsid

CONFIG = config_file("f1tenth.yaml")
SPEED = "/odom:twist.twist.linear.x"
TEST = ("05", "11", "16", "22", "27", "33", "38", "41")


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(CONFIG)


@pytest.fixture(scope="module")
def chain(f1tenth_chain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Everything `nlsid identify` and `nlsid funnel` write, through the command line."""
    return shutil.copytree(f1tenth_chain, tmp_path_factory.mktemp("chain") / "f1tenth")


def trial(name: str) -> Path:
    return next(bag for bag in f1tenth() if bag.name == f"trial_{name}")


def test_errors_on_the_test_trials_are_as_promised(config: Config, tmp_path: Path) -> None:
    """On the trials for which they were first measured, from raw starts."""
    everything = {"split": config.split.model_copy(update={"calibration": ()})}
    result = identify_bags(
        f1tenth(), config.model_copy(update=everything), tmp_path, progress=silent
    )
    errors = {
        c.method.name: simulation_percent(c.model, result.test) for c in result.fit.candidates
    }
    assert (errors["least_squares"], errors["sem"]) == pytest.approx((11.7, 8.5), abs=0.05)
    assert errors["rse"] <= 9.5
    assert set(result.test.names) == {f"trial_{k}" for k in TEST}
    assert len(result.train) == 33
    simulated = simulate_started(result.fit.model, result.test.trajectories, 20)
    left = [(y - t.y)[20:] for t, y in zip(result.test, simulated, strict=True)]
    rms = np.sqrt(np.mean(np.square(np.concatenate(left))))
    assert f" % ({rms:.2g} m/s). Proved: " in worth(result)


@pytest.mark.slow
def test_test_trials_do_not_influence_the_model(
    config: Config, chain: Path, tmp_path: Path
) -> None:
    fewer = [bag for bag in f1tenth() if bag.name[-2:] not in TEST[1:]]
    first = {"split": config.split.model_copy(update={"test": [f"trial_{TEST[0]}"]})}
    identify_bags(fewer, config.model_copy(update=first), tmp_path, progress=silent)
    one, other = (documents.load_model(each / documents.MODEL) for each in (tmp_path, chain))
    assert replace(one, training="").document() == replace(other, training="").document()


def test_the_model_names_the_bags_it_was_fitted_to(chain: Path) -> None:
    model = documents.load_model(chain / documents.MODEL)
    names = [name for name, _ in model.bags]
    assert len(names) == 17
    assert not {f"trial_{k}" for k in TEST} & set(names)
    assert all(digest.startswith("sha256:") for _, digest in model.bags)
    kept = load_trials(chain / documents.TRIALS, digest=model.training)["training"]
    assert kept.names == tuple(names)


def test_the_trials_that_scale_the_tube_made_neither_model_nor_observer(
    config: Config, chain: Path
) -> None:
    model = documents.load_model(chain / documents.MODEL)
    proved = documents.load(chain / documents.FUNNEL)
    for tube in proved.funnel.tubes:
        assert {name for name, _ in tube.measured.measured_on} == set(config.split.calibration)
        assert set(tube.measured.designed_on) == set(model.bags)
        assert not {d for _, d in tube.measured.measured_on} & {d for _, d in model.bags}
    said = of_proof(chain / documents.FUNNEL_PROOF).said[0]
    assert "raises an alarm of this funnel with probability at most 1/17" in said


def test_the_funnel_command_prints_bounds_rounded_outward(chain: Path, tmp_path: Path) -> None:
    again = shutil.copytree(chain, tmp_path / "again")
    made = nlsid("funnel", again, "--config", CONFIG, "--verbose")
    said = " ".join(made.replace("│", " ").split())
    tube = documents.load(chain / documents.FUNNEL).funnel.tubes[0]
    found = re.search(r"E <= (\S+) .*? energy of tube 1: (\S+) by the scale of 16", said)
    assert found
    level, measured = found.groups()
    assert 0.999 * tube.level < float(level) <= tube.level
    assert tube.measured.largest <= float(measured) < 1.001 * tube.measured.largest
    assert "probability at most 1/17" in said


def test_false_alarms_are_promised_as_far_as_the_calibration_trials_go(
    chain: Path, tmp_path: Path
) -> None:
    """Three of 17: the third largest scale, and no factor on it."""
    again = shutil.copytree(chain, tmp_path / "again")
    said = nlsid("funnel", again, "--config", CONFIG, "--false-alarms", 0.2)
    assert "with probability at most 3/17" in " ".join(said.replace("│", " ").split())
    before, tube = (documents.load(d / documents.FUNNEL).funnel.tubes[0] for d in (chain, again))
    assert (tube.measured.rank, tube.measured.safety_factor) == (3, 1.0)
    assert tube.level < before.level
    few = nlsid("funnel", again, "--config", CONFIG, "--false-alarms", 0.01, status=None)
    assert "record more for less" in few


@pytest.mark.slow
def test_the_funnel_command_says_what_the_funnel_catches(chain: Path, tmp_path: Path) -> None:
    """In a copy of the chain's folder: the same numbers in the terminal and in the report."""
    out = tmp_path / "copy"
    shutil.copytree(chain, out)
    arguments = ["funnel", str(out), "--config", str(CONFIG)]
    made = nlsid(*arguments)
    lines = {line[:20].strip(): line[20:].split() for line in made.splitlines()}
    assert lines["untouched"] == ["0", "0", "0", "0", "-", "0", "-", "0", "-", "0", "-"]
    for fault in ("sensor x 0.6", "sensor x 0.8", "actuator x 0.8", "bias, 10 % of range"):
        caught = 7 if fault.startswith("bias") else 8
        assert int(lines[fault][0]) + int(lines[fault][1]) == caught
        assert lines[fault][5] == "8", "CUSUM"
    assert lines["5 samples lost"][:5] == ["0", "0", "0", "8", "-"]
    assert "half-width of speed: 0.215 m/s, 0.552 of its range, 0.39 m/s" in made
    assert "warning: the half-width of speed, 0.215 m/s, is 0.552 of its range" in made
    assert "trial_12 sets the level" in made
    page = (out / documents.REPORT).read_text()
    assert page.count("The funnel: what it can catch") == 1, "replaced, not added again"
    [row] = re.findall(r"sensor x 0\.8(.*?)</tr>", page)
    assert re.sub("<[^>]*>", " ", row).split() == lines["sensor x 0.8"]
    assert "trial_12 sets the level" in page
    assert (out / documents.CATCHING_PLOT).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_single_recording_is_cut_into_windows_and_says_what_that_is_worth(tmp_path: Path) -> None:
    path = edited(tmp_path, funnel__horizon=1.0, funnel__profile=[[0.0, 0.3], [1.0, 0.35]])
    content = json.loads(path.read_text()) | {"split": {"share": 0.25}}
    path.write_text(json.dumps(content))
    common = ["--config", str(path)]
    nlsid("identify", tmp_path, trial("41"), *common)
    made = nlsid("funnel", tmp_path, *common)
    assert "of 1 held-back trial," in made
    proved = documents.load(tmp_path / documents.FUNNEL)
    said = of_proof(tmp_path / documents.FUNNEL_PROOF).said[0]
    assert "by the scale of 1 distinct window," in said
    assert said.endswith("as windows of one recording are hardly exchangeable")
    (digest,) = {digest for _, digest in proved.model.bags}
    for tube in proved.funnel.tubes:
        assert tube.measured.designed_on == (("trial_41[0:44]", f"{digest}[0:44]"),)
        assert tube.measured.measured_on[0][1] == f"{digest}[44:88]"


def test_a_model_of_another_class_is_named_as_configurations_name_it(
    chain: Path, config: Config, tmp_path: Path
) -> None:
    model = json.loads((chain / documents.MODEL).read_text()) | {"kind": "implicit"}
    files.write_document(tmp_path / documents.MODEL, model)
    with pytest.raises(DataError, match=r"kind is 'implicit', expected .* `model: linear`"):
        design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)


def test_a_tube_is_not_scaled_on_training_trials_where_calibration_trials_are_named(
    config: Config, chain: Path, tmp_path: Path
) -> None:
    model = documents.load_model(chain / documents.MODEL)
    kept = load_trials(chain / documents.TRIALS, digest=model.training)
    del kept["calibration"]
    digest = save_trials(tmp_path / documents.TRIALS, kept)
    files.write_document(tmp_path / documents.MODEL, replace(model, training=digest).document())
    with pytest.raises(DataError, match=r"split\.calibration names .* beside the model are none"):
        design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)


def test_check_prints_proved_for_both_proofs(chain: Path) -> None:
    proofs = [str(chain / documents.MODEL_PROOF), str(chain / documents.FUNNEL_PROOF)]
    lines = [x for x in nlsid("check", *proofs).splitlines() if not x.startswith(" ")]
    assert len(lines) == 2
    assert all(line.startswith("PROVED ") and " margin " in line for line in lines)
    said = [line.removeprefix("PROVED ").split(": ")[0] for line in lines]
    assert said == proofs, "of several files each is named"
    assert nlsid("check", proofs[1]).startswith("PROVED tube: ")


def test_check_prints_rejected_with_the_reason_and_status_1(chain: Path, tmp_path: Path) -> None:
    for file in chain.glob("*.json"):
        shutil.copy(file, tmp_path)
    text = (tmp_path / documents.MODEL).read_text()
    (tmp_path / documents.MODEL).write_text(text.replace('"period": 0.025', '"period": 0.026'))
    done = nlsid("check", tmp_path / documents.FUNNEL_PROOF, status=1)
    assert done.startswith(f"REJECTED {tmp_path / documents.FUNNEL_PROOF}: ")
    assert "model.json is not the model this proof is about" in done


@pytest.mark.slow
def test_without_a_profile_the_tube_is_around_the_models_simulation(
    chain: Path, tmp_path: Path
) -> None:
    path = edited(tmp_path, funnel={"safety_factor": 1.5})
    for name in (documents.MODEL, documents.TRIALS):
        shutil.copy(chain / name, tmp_path)
    assert "for ever" in nlsid("funnel", tmp_path, "--config", path)
    assert not (tmp_path / documents.POLICY).exists()
    nlsid("check", tmp_path / documents.FUNNEL_PROOF)
    bags = [str(trial("05")), str(trial("11"))]
    held = ["monitor", str(tmp_path)]
    nlsid(*held, *bags)
    proved = documents.load(tmp_path / documents.FUNNEL)
    replayed = replay_bag(proved, trial("05"), centre=Centre.COMMAND)
    assert replayed.verdict == Status.INSIDE.value
    assert replayed.judged_span == pytest.approx(replayed.span)
    assert replayed.span > 2.0
    write_faulty_copy(
        trial("05"), tmp_path / "bag", "/odom:twist.twist.linear.x", FAULTS["zero after 1 s"]
    )
    nlsid(*held, tmp_path / "bag", status=1)


def test_a_command_is_held_as_long_by_the_monitor_as_by_identification(
    chain: Path, tmp_path: Path
) -> None:
    """The last command of a bag is thrown away: identification refuses the bag, so does replay."""
    bag = tmp_path / "trial_05"
    with Bag(trial("05")) as source, BagWriter(bag) as target:
        messages = list(source.messages())
        last = max(m.log_time_ns for m in messages) - 500_000_000
        for message in messages:
            if message.topic == "/cmd_vel" and message.log_time_ns > last:
                continue
            kind, _ = source.types_on(message.topic)
            put(target, message.log_time_ns, message.topic, kind, message.data)
    signals = {"responses": [SPEED], "excitations": ["/cmd_vel:twist.linear.x"]}
    grid = Grid(0.025, 0.1)
    [whole] = read_bags([trial("05")], **signals, grid=grid)  # type: ignore[arg-type]
    [fewer] = read_bags([bag], **signals, grid=grid)  # type: ignore[arg-type]
    assert documents.load_model(chain / documents.MODEL).u.path.endswith("|hold(0.1 s)")
    replayed = replay(chain, bag)
    judged = len(replayed.judged) + len(documents.load_model(chain / documents.MODEL))
    assert len(fewer) == judged < len(whole)
    assert replayed.verdict == Status.UNKNOWN.value
    assert "no commanded speed" in replayed.reason


def replay(chain: Path, bag: Path) -> Replay:
    proved = documents.load(chain / documents.FUNNEL)
    return replay_bag(proved, bag, centre=Centre.COMMAND)


@pytest.mark.parametrize("use", ["test", "calibration"])
@pytest.mark.parametrize("name", ["trial_5", "trial_?", "trial_04.2"])
def test_a_name_in_the_split_that_no_bag_has_is_refused(
    config: Config, use: str, name: str
) -> None:
    split = {"test": ("trial_05",), "calibration": ()}
    split[use] = (*split.get(use, ()), name)
    given = config.model_copy(update={"split": config.split.model_copy(update=split)})
    bags = [bag for bag in f1tenth() if bag.name in ("trial_04", "trial_05", "trial_06")]
    with pytest.raises(DataError, match=rf"split\.{use} names {re.escape(name)}"):
        read_trials(bags, given, progress=silent)


def test_a_bag_whose_samples_are_lost_on_the_way_is_unknown_not_inside(chain: Path) -> None:
    whole = replace(replay(chain, trial("05")), period=0.0)  # these stamps are not of one run
    waiting, inside = whole.readings[0], whole.readings[-1]
    nan = inside._replace(status=Status.UNKNOWN, reason="speed is nan at t = 2 s")
    outside = inside._replace(status=Status.OUTSIDE, reason="left")
    past = nan._replace(reason="the proof covers 117 samples; they are over")
    assert "waiting" in waiting.reason
    for readings, verdict, reason in (
        ((waiting, inside, nan, nan), Status.UNKNOWN, nan.reason),
        ((waiting, inside, past, past, waiting, inside), Status.UNKNOWN, past.reason),
        ((waiting, inside, inside), Status.INSIDE, ""),
        ((waiting, nan), Status.UNKNOWN, nan.reason),
        ((waiting, outside, nan), Status.OUTSIDE, "left"),
    ):
        found = replace(whole, readings=readings)
        assert (found.verdict, found.reason) == (verdict.value, reason)
    violated = outside._replace(status=Status.ASSUMPTION_VIOLATED)
    both = replace(whole, readings=(waiting, violated, inside, outside, outside))
    assert (both.first_bad, both.first_outside) == (violated, outside)
    parts = replace(whole, readings=(waiting, inside, past, past, nan))
    assert [stretch.reasons for stretch in parts.unjudged] == [(past.reason, nan.reason)]


def test_the_stretches_that_were_not_judged_begin_and_end(chain: Path) -> None:
    whole = replay(chain, trial("05"))
    waiting, inside = whole.readings[0], whole.readings[-1]
    nan = inside._replace(status=Status.UNKNOWN, reason="no speed at t = 2 s")
    said = (waiting, *[inside] * 4, nan, *[waiting] * 3, *[inside] * 5, nan, *[inside] * 4)
    stamps = [*range(14), *range(20, 25)]  # six samples never came
    readings = tuple(r._replace(t=float(t)) for r, t in zip(said, stamps, strict=True))
    found = replace(whole, readings=readings, period=1.0)
    assert [(part.start, part.end, part.samples, part.why) for part in found.unjudged] == [
        (5.0, 8.0, 4, "no speed at t = 2 s; then 3 to start a new run"),
        (14.0, 20.0, 7, "6 samples are missing; then no speed at t = 2 s"),
    ]
    assert found.span - found.judged_span == 4 + 7


def test_bags_of_another_period_are_said_once_with_both_periods(chain: Path) -> None:
    whole = replay(chain, trial("05"))
    off = whole.readings[-1]._replace(status=Status.UNKNOWN, reason="off the grid")
    slow = [
        replace(
            whole,
            name=f"slow_{k}",
            readings=tuple(off._replace(t=1.2 * whole.period * i) for i in range(20)),
        )
        for k in range(5)
    ]
    assert slow[0].paced == pytest.approx(1.2 * whole.period)
    assert slow[0].reason == "its samples come every 0.03 s, the model's every 0.025 s"
    assert not any(replay_lines(slow[0]))
    [said] = paced_lines([whole, *slow])
    assert "5 bags have samples of another period than the model's 0.025 s: " in said
    assert "slow_0 0.03 s, slow_1 0.03 s, slow_2 0.03 s and 2 more;" in said
    assert (whole.paced, list(paced_lines([whole]))) == (0.0, [])


def test_a_recording_that_hardly_outlasts_the_start_says_how_little_was_judged(
    chain: Path,
) -> None:
    whole = replay(chain, trial("05"))
    start = whole.starting
    short = replace(whole, readings=whole.readings[: start + 1])
    assert (short.starting, len(short.judged), short.verdict) == (start, 1, "inside")
    [*_, said] = replay_lines(short)
    few = f"only 1 of {start + 1} samples were judged: the first {start} start the run"
    assert said == f"{short.name}: {few}"
    assert not any("start the run" in line for line in replay_lines(whole))


@pytest.mark.parametrize("name", TEST)
def test_every_test_trial_is_inside_with_the_assumption_kept(chain: Path, name: str) -> None:
    result = replay(chain, trial(name))
    assert result.verdict == Status.INSIDE.value
    assert len(result.judged) == 117
    assert result.worst is not None
    assert result.worst.margin > 0
    assert result.assumption < 1


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", TEST)
def test_a_sabotaged_trial_is_caught_and_named(
    chain: Path, tmp_path: Path, name: str, fault: str
) -> None:
    write_faulty_copy(trial(name), tmp_path / "bag", "/odom:twist.twist.linear.x", FAULTS[fault])
    bad = replay(chain, tmp_path / "bag").first_bad
    assert bad is not None
    assert bad.status in (Status.OUTSIDE, Status.ASSUMPTION_VIOLATED)
    assert f"at t = {bad.t:g} s" in bad.reason
    assert "above the level" in bad.reason
    if fault == "zero after 1 s":
        assert 1.0 <= bad.t <= 1.025


def test_a_faulty_copy_differs_only_in_its_signal(tmp_path: Path) -> None:
    path = SignalPath.parse("/odom:twist.twist.linear.x")
    write_faulty_copy(trial("05"), tmp_path / "bag", str(path), FAULTS["scaled by 0.6"])
    signals = ["/odom:twist.twist.linear.x", "/odom:pose.pose.position.x"]
    before, after = (
        read_bags([bag], responses=signals, excitations=["/cmd_vel:twist.linear.x"])
        for bag in (trial("05"), tmp_path / "bag")
    )
    original, copy = before.trajectories[0], after.trajectories[0]
    np.testing.assert_array_equal(copy.y[:, 0], 0.6 * original.y[:, 0])
    np.testing.assert_array_equal(copy.y[:, 1], original.y[:, 1])
    np.testing.assert_array_equal(copy.u, original.u)


@pytest.mark.pictures
def test_monitor_command_summarises_draws_and_ends_with_status_0(chain: Path) -> None:
    bags = [str(trial(name)) for name in TEST]
    done = nlsid("monitor", chain, *bags)
    assert done.count("inside") == len(TEST)
    assert (chain / documents.MARGIN_PLOT).read_bytes().startswith(b"\x89PNG")


def test_monitor_command_ends_with_status_1_if_a_bag_is_not_inside(
    chain: Path, tmp_path: Path
) -> None:
    write_faulty_copy(
        trial("05"), tmp_path / "bad", "/odom:twist.twist.linear.x", FAULTS["scaled by 0.6"]
    )
    plot = str(tmp_path / "plot.png")
    done = nlsid("monitor", chain, tmp_path / "bad", "--out", plot, status=1)
    assert "innovation energy" in done


def test_the_report_is_one_file_with_its_pictures(chain: Path) -> None:
    page = (chain / documents.REPORT).read_text()
    assert page.count("<svg") == 3  # trials, residuals, what the funnel catches
    assert "src=" not in page
    assert 'href="http' not in page
    assert 'class="proved"' in page


def test_with_policy_none_the_funnel_is_a_prediction_tube(
    chain: Path, config: Config, tmp_path: Path
) -> None:
    assert config.funnel is not None
    prediction = config.model_copy(
        update={"funnel": config.funnel.model_copy(update={"policy": None})}
    )
    for name in (documents.MODEL, documents.TRIALS):
        shutil.copy(chain / name, tmp_path)
    design = design_funnel_files(tmp_path / documents.MODEL, prediction, tmp_path)
    assert design.policy is not None
    assert not design.policy.K.any()
    verdict = documents.load(tmp_path / documents.FUNNEL).verdict
    assert "no feedback" in verdict.statement


def test_a_funnel_is_not_designed_on_other_data_than_the_models(
    chain: Path, config: Config, tmp_path: Path
) -> None:
    shutil.copy(chain / documents.MODEL, tmp_path)
    content = (chain / documents.TRIALS).read_bytes()
    (tmp_path / documents.TRIALS).write_bytes(content[:-1] + b"\1")
    with pytest.raises(DataError, match="not the trials of this model"):
        design_funnel_files(tmp_path / documents.MODEL, config, tmp_path)
    assert not (tmp_path / documents.FUNNEL).exists()


@pytest.mark.parametrize(
    "verb",
    [
        ("monitor", "DIR", "BAG"),
        pytest.param(("check", "DIR"), marks=pytest.mark.slow),
        pytest.param(("bag", "info", "BAG"), marks=pytest.mark.slow),
        ("bag", "signals", "BAG", "--json"),
        pytest.param(("fleet", "monitor", "DIR", "BAG"), marks=pytest.mark.slow),
    ],
)
def test_the_status_is_the_same_where_nobody_reads_what_is_said(
    chain: Path, verb: tuple[str, ...]
) -> None:
    """As in `nlsid ... | head`: status 1 means outside, bad or rejected, and nothing is."""
    words = {"DIR": chain, "BAG": trial("05")}
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "bags.commands.main", *(str(words.get(w, w)) for w in verb)]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert done.returncode == 0, done.stderr


def test_what_cannot_be_written_is_said_in_a_line() -> None:
    command = [sys.executable, "-m", "bags.commands.main", "bag", "info", str(trial("05"))]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False)
    assert done.returncode == 2
    assert done.stderr.decode().splitlines() == ["error: [Errno 28] No space left on device"]


@pytest.mark.pictures
def test_a_picture_is_not_overwritten_where_nothing_was_judged(chain: Path, tmp_path: Path) -> None:
    with Bag(trial("05")) as source, BagWriter(tmp_path / "short") as target:
        for message in list(source.messages())[:9]:
            kind, _ = source.types_on(message.topic)
            put(target, message.log_time_ns, message.topic, kind, message.data)
    picture = tmp_path / "monitor.png"
    picture.write_bytes(b"of another run")
    arguments = ["monitor", str(chain), str(tmp_path / "short"), "--out", str(picture)]
    nlsid(*arguments, status=2)
    assert picture.read_bytes() == b"of another run"


def edited(tmp_path: Path, **changes: object) -> Path:
    """The shipped configuration with dotted keys changed."""
    import yaml

    content = yaml.safe_load(CONFIG.read_text())
    for dotted, value in changes.items():
        section, _, key = dotted.partition("__")
        content[section] = content[section] | {key: value} if key else value
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"identification__lags": 0}, "identification.lags"),
        ({"identification__lags": "4"}, "identification.lags"),
        ({"grid__period": float("nan")}, "grid.period"),
        ({"grid__perod": 0.1}, "grid.perod"),
        ({"funnel__profile": [[0.0, 0.0]]}, "funnel.profile"),
        ({"funnel__profile": [[0.0, 0.0], [0.0, 1.0]]}, "times should increase"),
        ({"funnel__profile": None}, "an LQR policy tracks a profile"),
        ({"funnel__safety_factor": 0.9}, "funnel.safety_factor"),
        ({"monitor__nominal": "guess"}, "monitor.nominal"),
    ],
)
def test_a_wrong_configuration_names_the_key(
    tmp_path: Path, changes: dict[str, object], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        load_config(edited(tmp_path, **changes))


@pytest.mark.parametrize("text", ["", "- 1", "a: [", "!!python/object/apply:os.system ['true']"])
def test_a_configuration_that_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(DataError, match=r"config\.yaml"):
        load_config(path)


@pytest.mark.parametrize(
    ("bags", "changes", "reason"),
    [
        (["nowhere"], {}, "there is no bag"),
        (["01", "02"], {}, "split.test names trial_05; the bags are trial_01, trial_02; did you "),
        (["05"], {}, "all of the bags are test trials"),
        (
            ["01", "05", "06"],
            {"split__test": ["trial_05", "trial_6"]},
            "the bags are trial_01, trial_05, trial_06; did you mean 'trial_06'?",
        ),
        (["01", "05"], {"grid__period": 0.05}, "period"),
        (["06", "07", "05"], {}, "constant"),
        (["01", "02", "05"], {"identification__lags": 40}, "equations for 82 parameters"),
    ],
)
def test_bad_input_ends_in_one_message_and_leaves_nothing_behind(
    tmp_path: Path, bags: list[str], changes: dict[str, object], reason: str
) -> None:
    out = tmp_path / "out"
    paths = [str(trial(b)) if b.isdigit() else str(tmp_path / b) for b in bags]
    split = {"split__test": ["trial_05"], "split__calibration": []}
    config = str(edited(tmp_path, **(split | changes)))
    assert reason in nlsid("identify", out, *paths, "--config", config, status=None)
    assert not out.exists()
