"""A continuous funnel made by hand: the monitor's and the controller's, not the checker's."""

from pathlib import Path

import numpy as np

from bags.chain.joint_bags import JOINTS, _make
from bags.monitoring.announcement import Run
from bags.recordings.message_types import standard_types
from bags.recordings.writer import BagWriter
from nlsid_core import files
from nlsid_core.arrays import FloatArray
from nlsid_core.design import ContinuousTracking, Goal, compose_funnels, design
from nlsid_core.designs import AnyDesign
from nlsid_core.dynamics import Nominal, VectorField, constant_on, linear_through
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy

RADIUS = 0.2  # m at the start; it shrinks to half of it

Stage = tuple[VectorField, ContinuousPolicy, ContinuousFunnel]


def stage(t0: float = 0.0, radius: float = RADIUS, *, limit: float | None = None) -> Stage:
    """ẋ = u along x₀ = t from t0 to t0 + 1 s, u = 1 - 4 x̄; half as wide at the end."""
    field = VectorField.from_function(lambda x, u: [u[0]], 1, 1)  # noqa: ARG005
    digest = files.digest(field.document())
    t = np.linspace(t0, t0 + 1.0, 5)
    x = linear_through(t, t[:, None])
    policy = ContinuousPolicy(
        x,
        constant_on(t, np.ones((4, 1))),
        constant_on(t, np.full((4, 1, 1), 4.0)),
        digest,
        limits=np.zeros((0, 3)) if limit is None else np.array([[0, -limit, limit]]),
    )
    rho = (np.linspace(radius, radius / 2, 5)) ** 2
    funnel = ContinuousFunnel(x, np.ones((5, 1, 1)), rho, digest, files.digest(policy.document()))
    return field, policy, funnel


def composed(folder: Path) -> Path:
    """Two such stages, proved and composed in `folder`, which is returned."""
    goal: Goal | FloatArray = np.array([[25.0]])
    proofs: list[Path] = []
    for t0 in (1.0, 0.0):
        field, policy, _ = stage(t0)
        nominal = Nominal(policy.x, policy.u)
        found = design(ContinuousTracking(field, nominal, goal=goal, policy=policy))
        proofs.insert(0, found.save(folder / f"from {t0:g}")[-1])
        goal = Goal.start_of(found.funnel)
    return compose_funnels(proofs, folder / "whole").parent


def write_run(path: Path, design: AnyDesign, samples: list[tuple[FloatArray, FloatArray]]) -> None:
    """A bag of one announced run from the second sample on: (states, inputs) on two topics."""
    start_ns, period_ns, empty = 10**12, round(design.period * 1e9), np.zeros(0)
    with BagWriter(path) as writer:

        def write(topic: str, kind: str, stamp_ns: int, content: object) -> None:
            data = bytes(standard_types().serialize_cdr(content, kind, little_endian=True))
            writer.write(topic, kind, data, log_time_ns=stamp_ns, publish_time_ns=stamp_ns)

        text = files.encode(Run(start_ns, design.digest).document()).decode()
        string = "std_msgs/msg/String"
        write("/controller/run", string, start_ns, _make(string, text))
        for k, (state, effort) in enumerate([(samples[0][0], np.ones(1)), *samples]):
            stamp_ns = start_ns + (k - 1) * period_ns
            stamp = _make("builtin_interfaces/msg/Time", stamp_ns // 10**9, stamp_ns % 10**9)
            header = _make("std_msgs/msg/Header", stamp, "")
            write("/joints", JOINTS, stamp_ns, _make(JOINTS, header, ["j"], state, empty, empty))
            write("/effort", JOINTS, stamp_ns, _make(JOINTS, header, ["j"], empty, empty, effort))
