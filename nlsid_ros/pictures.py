"""A funnel as RViz, Foxglove and trajectory tools show it."""

from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from nlsid_core.arrays import FloatArray
from nlsid_core.designs import AnyDesign
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.tube import TubeFunnel

LIFETIME = 3  # s after the publisher last said so
LINE = 0.005  # m, width of the lines
NOMINAL, EDGE = ColorRGBA(r=0.2, g=0.4, b=1.0, a=1.0), ColorRGBA(r=0.2, g=0.7, b=0.2, a=1.0)


@dataclass(frozen=True)
class Plan:
    """What is drawn: t (N,) s, the names of the signals, nominal and half-widths (N, n), and the
    nominal inputs (M, m), M <= N.
    """

    t: FloatArray
    names: tuple[str, ...]
    nominal: FloatArray
    half_widths: FloatArray
    inputs: FloatArray


def plan_of(design: AnyDesign) -> Plan:
    """The output of a linear model, y_k = C x_k + D u_k + c; of the others every state."""
    names, policy = tuple(signal.name for signal in design.signals[0]), design.policy
    if isinstance(design.funnel, ContinuousFunnel):
        columns: list[list[FloatArray]] = [[], [], [], []]
        for stage in design.stages:  # a knot where stages change belongs to the later one
            funnel, end = stage.funnel, None if stage is design.stages[-1] else -1
            half = np.array([funnel.widths(t) for t in funnel.t])
            parts = (funnel.t - design.funnel.t0, funnel.x.ends(), half, stage.policy.planned)
            for column, part in zip(columns, parts, strict=True):
                column.append(part[:end])
        t, *others = map(np.concatenate, columns)
        return Plan(t, names, *others)
    if isinstance(design.funnel, TubeFunnel):
        nominal = policy.plan(design.model).y[:, None]
        times = np.arange(len(nominal)) * policy.period
        widths = np.full_like(nominal, design.funnel.half_width)
        return Plan(times, names, nominal, widths, policy.u[:, None])
    times = np.arange(len(policy.x)) * policy.period
    return Plan(times, names, policy.x, design.funnel.half_widths, policy.u)


def tube_markers(design: AnyDesign, frame: str, stamp: Time) -> MarkerArray:
    """The plan and the tube's edges over time: 1 m along x is 1 s, along y one unit.

    They move with `frame`, the robot's own as base_link, and go after LIFETIME.
    """
    plan, markers = plan_of(design), [Marker(action=Marker.DELETEALL)]
    markers[0].header.frame_id, markers[0].header.stamp = frame, stamp
    columns = zip(plan.names, plan.nominal.T, plan.half_widths.T, strict=True)
    for name, nominal, width in columns:
        lines = ((nominal, NOMINAL), (nominal + width, EDGE), (nominal - width, EDGE))
        for number, (values, color) in enumerate(lines):
            marker = Marker(ns=f"tube {name}", id=number, type=Marker.LINE_STRIP, action=Marker.ADD)
            marker.header.frame_id, marker.header.stamp = frame, stamp
            marker.frame_locked, marker.lifetime = True, Duration(sec=LIFETIME)
            marker.pose.orientation.w = 1.0
            marker.scale.x, marker.color = LINE, color
            marker.points = [
                Point(x=t, y=value)
                for t, value in zip(plan.t.tolist(), values.tolist(), strict=True)
            ]
            markers.append(marker)
    return MarkerArray(markers=markers)


def nominal_trajectory(design: AnyDesign) -> JointTrajectory:
    """The plan: of a linear model the output as position, the input as effort; of a state the
    first half as positions, the rest as velocities.
    """
    plan = plan_of(design)
    joints = (len(plan.names) + 1) // 2
    message = JointTrajectory(joint_names=list(plan.names[:joints]))
    for t, state, efforts in zip(plan.t.tolist(), plan.nominal, plan.inputs, strict=False):
        seconds, nanoseconds = divmod(round(t * 1e9), 10**9)
        message.points.append(
            JointTrajectoryPoint(
                positions=state[:joints].tolist(),
                velocities=state[joints:].tolist(),
                effort=efforts.tolist(),
                time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
            )
        )
    return message
