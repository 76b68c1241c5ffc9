"""Bags of a robot with a friction, equations without, and the funnel between them."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bags.chain.joint_bags import write_joint_bag
from bags.monitoring.catching import breaking
from nlsid import Dataset, Goal, Trajectory, VectorField, check, plan_motion
from nlsid_core import files
from nlsid_core.dynamics import MeasuredPush, measured_push
from nlsid_core.errors import DocumentError
from tests import funnel_problem
from tests.verbs import nlsid

PERIOD, PUSH, FACTOR = 0.02, 0.06, 1.2  # s, m/s², of the box over the largest
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
    x, h = np.zeros((len(u), 2)), PERIOD / 50
    for k in range(len(u) - 1):
        z = x[k].copy()
        for _ in range(50):
            a = u[k, 0] - PUSH * np.tanh(20 * z[1])
            z += h * np.array([z[1] + h / 2 * a, a])
        x[k + 1] = z
    return Trajectory(t=PERIOD * np.arange(len(u)), y=x, u=u, name=f"run_{seed}")


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
    assert re.search(r"late by 5 samples .* 3 of 3", said), "the velocity contradicts the command"
    assert re.search(r"stuck at first value .* 3 of 3", said)
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


def test_a_weaker_actuator_breaks_the_box_once_it_takes_more_than_the_friction() -> None:
    trials = Dataset(tuple(recorded(seed) for seed in range(3)))
    push = measured_push(FIELD, trials, safety_factor=FACTOR)
    assert max(push.used(FIELD, trial) for trial in trials) == pytest.approx(1 / FACTOR)
    assert breaking(trials, lambda t: push.used(FIELD, t)).counts["actuator x 0.8"] == 3
    rest = replace(trials.trajectories[0], y=np.zeros((200, 2)), u=np.zeros((200, 1)))
    assert breaking(Dataset((rest,)), lambda t: push.used(FIELD, t)).counts["sensor x 0.6"] == 0


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
