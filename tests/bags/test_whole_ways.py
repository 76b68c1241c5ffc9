"""Whole ways through bags: pushes, springs, simulated robots, positions, commissioning."""

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from bags.chain.config import load_config
from bags.chain.joint_bags import write_joint_bag
from bags.chain.plants import PERIOD, Plant
from bags.chain.simulation import record_repeats
from bags.chain.steps import read_signals_of
from bags.chain.tracking_config import SimulationConfig, load_tracking_config
from bags.chain.tracking_steps import widest_start
from bags.designs.displacement import displacement_half_width, washouts_of
from nlsid import Dataset, Goal, Trajectory, VectorField, check, f1tenth, plan_motion
from nlsid_core import files
from nlsid_core.dynamics import MeasuredPush
from nlsid_core.errors import DocumentError
from nlsid_core.models import Signal
from tests import funnel_problem
from tests.duffing import trials
from tests.identified_bags import FUNNEL, write_bag, write_config
from tests.tracked import designed, run
from tests.verbs import nlsid

PUSHED_PERIOD, PUSH, FACTOR = 0.02, 0.06, 1.2  # s, m/s², of the box over the largest
SIGNALS = [
    "-y",
    "/joint_states:position[0]",
    "-y",
    "/joint_states:velocity[0]",
    "-u",
    "/joint_commands:effort[0]",
]
FIELD = VectorField.from_function(lambda x, u: [x[1], u[0]], 2, 1)


def recorded(seed: int) -> Trajectory:
    """A mass that friction of at most PUSH slows down, pushed at random."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-0.5, 0.5, (8, 1)), 25, axis=0)
    x, h = np.zeros((len(u), 2)), PUSHED_PERIOD / 50
    for k in range(len(u) - 1):
        z = x[k].copy()
        for _ in range(50):
            a = u[k, 0] - PUSH * np.tanh(20 * z[1])
            z += h * np.array([z[1] + h / 2 * a, a])
        x[k + 1] = z
    return Trajectory(t=PUSHED_PERIOD * np.arange(len(u)), y=x, u=u, name=f"run_{seed}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A problem without friction, and three bags with it."""
    folder = tmp_path_factory.mktemp("push")
    motion = plan_motion(FIELD, start=[0, 0], end=[0.2, 0], seconds=1, u=[0])
    end = motion.x.ends()[-1]
    goal = Goal(end, np.diag([25.0, 11.0]))
    files.write_document(folder / "problem.json", funnel_problem.document(FIELD, motion, goal))
    (folder / "bags").mkdir()
    for seed in range(3):
        write_joint_bag(folder / "bags", recorded(seed))
    return folder


def told(folder: Path, *options: str, status: int | None = 0) -> str:
    bags, problem = folder / "bags", folder / "problem.json"
    given = ("funnel", folder / "design", bags, "--problem", problem, *SIGNALS)
    return nlsid(*given, *options, status=status)


@pytest.mark.slow
def test_what_bags_show_is_stored_with_their_digests_and_the_funnel_is_proved_for_it(
    folder: Path,
) -> None:
    said = told(folder, "--safety-factor", str(FACTOR))
    assert "largest of 3 distinct trials, safety factor 1.2" in said
    assert "measured, not proved: |dx/dt - f|" in said
    out = folder / "design"
    push = MeasuredPush.from_document(files.load_document(out / "push.json"))
    assert push.box[1, 1] == pytest.approx(FACTOR * PUSH, rel=0.03)
    names, digests = zip(*push.measured_on, strict=True)
    assert sorted(names) == ["run_0", "run_1", "run_2"]
    assert len({d for d in digests if d}) == 3

    proved_for = VectorField.from_document(files.load_document(out / "vector_field.json"))
    np.testing.assert_array_equal(proved_for.uncertain, push.box)
    assert "w1" in str(check(out / "funnel.proof.json"))


def test_bags_with_other_states_than_the_equations_are_refused(folder: Path) -> None:
    said = told(folder, "-y", "/joint_states:position[0]", status=None)
    assert "3 states (as y) and 1 inputs, the dynamics 2 and 1" in said


def test_a_push_on_one_state_adds_one_w() -> None:
    field = FIELD.pushed([[0.0, 0.0], [-0.1, 0.1]])
    assert field.uncertain.tolist() == [[-0.1, 0.1]]
    assert field(0.0, [[0.0, 2.0]], [[0.5]], [0.1]).tolist() == [[2.0, 0.6]]


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"seconds": 0.0}, "seconds above 0"),
        ({"safety_factor": 0.5}, "1 or more"),
        ({"largest": [[-1.0, 0.0]]}, "0 or more"),
        ({"largest": [], "measured_on": []}, "a trial"),
    ],
)
def test_a_push_that_says_nothing_is_refused(changed: dict[str, object], reason: str) -> None:
    push = MeasuredPush(np.ones((1, 2)), (("a", "b" * 64),), 0.02, 1.5)
    with pytest.raises(DocumentError, match=reason):
        MeasuredPush.from_document(push.document() | changed)


# -- Bags of an oscillator whose spring stiffens: identified, checked, given a tube and monitored

RUNS, SAMPLES = 8, 240


@pytest.mark.slow
def test_init_proposes_feedback_where_linear_models_say_little(tmp_path: Path) -> None:
    for k, trial in enumerate(trials([0.15, 0.25] * 3, samples=300, damping=0.25)):
        write_bag(tmp_path / "bags", f"run_{k}", trial.y, trial.u)
    config = tmp_path / "out" / "robot.yaml"
    drive, answer = ("/joint_commands:effort[name=joint_0]", "/joint_states:position[name=joint_0]")
    nlsid("init", config.parent, tmp_path / "bags", "-u", drive, "-y", answer)
    assert load_config(config).identification.given["model"] == "feedback"
    said = " ".join(config.read_text().replace("#", "").split())
    polynomial = re.search(r"polynomial, [^%]*: ([0-9.]+) %", said)
    promised = re.search(r"simulation of [0-9.]+ to ([0-9.]+) %", said)
    assert polynomial
    assert promised
    assert float(promised[1]) < float(polynomial[1]), "even at its worst"


@pytest.mark.slow
def test_feedback_goes_from_bags_to_a_monitor(tmp_path: Path) -> None:
    for k, trial in enumerate(trials([0.15] * RUNS, samples=SAMPLES, seed=4)):
        write_bag(tmp_path / "bags", f"run_{k}", trial.y, trial.u)
    broken = trials([0.15], samples=SAMPLES, seed=9).trajectories[0]
    y = np.where(np.arange(SAMPLES)[:, None] < SAMPLES // 2, broken.y, 0.6 * broken.y)
    write_bag(tmp_path / "bags", "broken", y, broken.u)
    section = {"model": "feedback", "stages": 2, "imitated": 20}
    config = write_config(tmp_path / "config.yaml", section, **FUNNEL)
    bags = [tmp_path / "bags" / f"run_{k}" for k in range(RUNS)]
    out = tmp_path / "out"
    nlsid("identify", out, *bags, "--config", config)
    nlsid("funnel", out, "--config", config)
    assert nlsid("check", out).count("PROVED") == 2
    nlsid("monitor", out, bags[5])
    nlsid("monitor", out, tmp_path / "bags" / "broken", status=1)


# -- MuJoCo robots as sources of recordings, and the whole chain on one of them through bags

pytest.importorskip("mujoco", reason="simulated robots need the extra `sim`")

ROOT = Path(__file__).resolve().parents[2]


def test_a_pendulum_swings_at_the_period_of_small_oscillations_and_comes_to_rest() -> None:
    plant = Plant("pendulum", np.random.default_rng(0))
    plant.reset([0.1, 0.0])
    angles = []
    for _ in range(3000):
        angles.append(plant.state[0])
        plant.step([0.0])
    crossings = np.flatnonzero(np.diff(np.sign(angles[:300])))
    inertia = 1.0 + 0.01  # kg m², of the mass at 1 m and of its own
    expected = np.pi * np.sqrt(inertia / 9.81)
    assert np.diff(crossings).mean() * PERIOD == pytest.approx(expected, rel=0.05)
    assert abs(angles[-1]) <= 0.02 / 9.81  # dry friction holds it that near to the bottom


def test_sensor_noise_has_the_stated_size_and_runs_repeat_with_their_seed() -> None:
    def recorded(seed: int) -> np.ndarray:
        plant = Plant("arm", np.random.default_rng(seed))
        return np.array([plant.measure() for _ in range(4000)])

    np.testing.assert_allclose(recorded(1).std(axis=0), [1e-3, 1e-3, 1e-2, 1e-2], rtol=0.06)
    assert (recorded(1) == recorded(1)).all()
    assert (recorded(1) != recorded(2)).any()


def test_drives_do_not_give_more_than_their_limit() -> None:
    states = []
    for torque in (20.0, 1000.0):
        plant = Plant("pendulum", np.random.default_rng(0))
        plant.step([torque])
        states.append(plant.state)
    np.testing.assert_array_equal(states[0], states[1])


def test_bags_of_a_simulated_robot_read_back_bit_for_bit_as_repeats(tmp_path: Path) -> None:
    options = SimulationConfig(robot="arm", peak=(4.0, 2.0), groups=1, repeats=2, seconds=1.0)
    data = list(record_repeats(options))
    bags = [write_joint_bag(tmp_path, trial) for trial in data]
    again = read_signals_of(bags, load_tracking_config(ROOT / "config" / "arm.yaml"))
    for trial, read in zip(data, again, strict=True):
        np.testing.assert_array_equal(read.y, trial.y)
        np.testing.assert_array_equal(read.u, trial.u)
        assert read.name == trial.name
    assert len(again.repeats()) == 1


def test_an_unknown_simulated_robot_is_an_error(tmp_path: Path) -> None:
    config = tmp_path / "robot.yaml"
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    config.write_text(text.replace("  robot: pendulum\n", "  robot: pendulums\n"))
    said = nlsid("demo", "--robot", config, "--out", tmp_path, status=None)
    assert "there are: arm, pendulum" in said
    assert "is not this demo's" in nlsid("demo", "--out", tmp_path, status=None)  # nothing is lost


@pytest.mark.slow
@pytest.mark.pictures
def test_the_whole_chain_runs_from_one_configuration(tmp_path: Path) -> None:
    text = (ROOT / "config" / "pendulum.yaml").read_text()
    for given, shorter in (
        ("[pendulum_4_0, pendulum_4_1, pendulum_4_2, pendulum_4_3]", "[pendulum_2_0]"),
        ("duration: 1.5\n", "duration: 0.3\n"),
        ("[0.6,", "[0.1,"),
        ("groups: 5", "groups: 3"),
        ("repeats: 4", "repeats: 2"),
        ("seconds: 60.0", "seconds: 12.0"),
        ("runs: 30", "runs: 3"),
        ("identification:\n", "identification:\n  degrees: [[3, 1, 1]]\n"),
    ):
        assert given in text
        text = text.replace(given, shorter)
    config = tmp_path / "pendulum.yaml"
    config.write_text(text)
    out = tmp_path / "out"
    said = nlsid("demo", "--robot", config, "--out", out)
    assert "PROVED funnel" in said
    assert "3 of 3 bags are inside" in said
    for name in ("free_run.png", "funnel.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
        assert f"wrote {out / name}" in said
    assert nlsid("check", out).startswith("PROVED")
    nlsid("monitor", out, out / "runs")
    refused = nlsid("funnel", out, out / "excitations", "--config", config, status=None)
    assert "fitted on" in refused


# -- What a tube of a washed-out position says of the position

CONFIG = """\
robot: car
signals:
  response: {name: position, unit: m, path: "/odom:pose.pose.position.x|washout(1 s)"}
  excitation: {name: command, unit: m/s, path: "/cmd_vel:twist.linear.x"}
grid: {period: 0.025, max_gap: 0.1}
split: {test: [trial_37, trial_41], calibration: [trial_35, trial_38, trial_40]}
identification: {lags: 4}
funnel: {level: constant}
"""


@pytest.mark.parametrize("span", [0.1, 1.0, 2.0, 7.0])
def test_no_errors_of_the_washed_out_position_add_up_to_more_and_the_worst_do_to_nearly_that(
    span: float,
) -> None:
    """The worst p of all |errors of q| ≤ w is w times the sum of the weights of q in p."""
    w, T, period = 0.3, 2.0, 0.01
    a, steps = np.exp(-period / T), round(span / period)
    # the error of p from that of q by the filter's inverse, (1 - a/z)/(1 - 1/z), unit by unit
    units = np.vstack([np.zeros(steps + 1), np.eye(steps + 1)])
    p = lfilter([1.0, -a], [1.0, -1.0], units, axis=0)
    worst = w * np.abs(p[-1] - p[1]).sum()
    bound = float(displacement_half_width(w, Fraction(span), Fraction(T)))
    assert worst <= bound
    assert worst == pytest.approx(bound, rel=0.01)


def test_a_displacement_is_told_of_samples_that_are_washed_out_messages() -> None:
    x, y, other, plain = (
        Signal("x", "m", path)
        for path in ("/a:x|washout(0.5 s)", "/a:y|washout(2 s)", "/b:z|washout(1 s)", "/a:x")
    )
    for signals, washouts in (
        ([x, y], [Fraction(1, 2), Fraction(2)]),
        ([plain, y], [None, Fraction(2)]),
        ([Signal("x", "m")], [None]),
        # Of /b only the messages at the stamps of /a are samples; others may come between them.
        ([x, other], [Fraction(1, 2), None]),
    ):
        assert washouts_of(signals) == washouts


@pytest.mark.slow
@pytest.mark.pictures
def test_the_shipped_cars_way_is_proved_and_held_against_its_tube(tmp_path: Path) -> None:
    config = tmp_path / "position.yaml"
    config.write_text(CONFIG)
    out = tmp_path / "out"
    bags = [bag for bag in f1tenth() if bag.name >= "trial_34"]
    nlsid("identify", out, *bags, "--config", config)
    designed = nlsid("funnel", out, "--config", config)
    said = " ".join(re.sub(r"[│\n]", " ", designed).split())
    found = re.search(r"position stays within (\S+) m of the model's simulation", said)
    moves = re.search(r"moves in at most 1 s is within (\S+) m of what the simulation moves", said)
    assert found
    assert moves
    assert 3 * float(found[1]) <= float(moves[1]) * 1.0001 < 0.5
    test = [bag for bag in bags if bag.name in ("trial_37", "trial_41")]
    held = nlsid("monitor", out, *test, status=1)  # an alarm of which nothing is proved
    verdicts = re.findall(r"^trial_\d+ (\w+(?:, \w+)?)", held, re.MULTILINE)
    assert verdicts == ["inside", "inside, alarm"]


# -- How far out commissioning runs start, beside the inlet that is claimed


@pytest.mark.slow
def test_the_widest_start_is_told_in_parts_of_the_inlet() -> None:
    made = designed()
    edge = np.linalg.solve(made.funnel.S[0], [float(made.funnel.inlet[0]), 0.0])
    runs = Dataset(
        tuple(
            run(seed=i, start=made.policy.x[0] + p * edge) for i, p in enumerate((0.1, -0.5, 0.0))
        )
    )
    assert widest_start(made, runs) == pytest.approx(0.5, abs=0.1)
