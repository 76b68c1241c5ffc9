"""A funnel as RViz, Foxglove and trajectory tools show it."""

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from bags.monitoring.designs import Design, LinearDesign
from nlsid_core._types import FloatArray

LINE = 0.005  # m, width of the lines
NOMINAL, EDGE = ColorRGBA(r=0.2, g=0.4, b=1.0, a=1.0), ColorRGBA(r=0.2, g=0.7, b=0.2, a=1.0)


def tube_lines(design: Design) -> list[tuple[str, FloatArray, FloatArray]]:
    """(name, nominal (N,), half-width (N,) or scalar) of what is drawn, in the signals' units.

    The output of a difference equation, y_k = C x_k + D u_k + c; of a state model every state.
    """
    if isinstance(design, LinearDesign):
        nominal = design.policy.x[:, 0] + design.model.D * design.policy.u + design.model.c
        return [(design.model.y.name, nominal, np.array(design.funnel.half_width))]
    columns = zip(design.model.x, design.policy.x.T, design.funnel.half_widths.T, strict=True)
    return [(signal.name, nominal, width) for signal, nominal, width in columns]


def tube_markers(design: Design, frame: str) -> MarkerArray:
    """The plan and the tube's edges over time: 1 m along x is 1 s, along y one unit."""
    markers = []
    for name, nominal, width in tube_lines(design):
        lines = ((nominal, NOMINAL), (nominal + width, EDGE), (nominal - width, EDGE))
        for number, (values, color) in enumerate(lines):
            marker = Marker(ns=f"tube {name}", id=number, type=Marker.LINE_STRIP, action=Marker.ADD)
            marker.header.frame_id = frame
            marker.pose.orientation.w = 1.0
            marker.scale.x, marker.color = LINE, color
            marker.points = [
                Point(x=k * design.policy.period, y=float(value)) for k, value in enumerate(values)
            ]
            markers.append(marker)
    return MarkerArray(markers=markers)


def nominal_trajectory(design: Design) -> JointTrajectory:
    """The plan: of a difference equation the output as position, the input as effort; of a state
    model the first half of the state as positions, the rest as velocities.
    """
    columns = [nominal for _, nominal, _ in tube_lines(design)]
    u = design.policy.u.reshape(len(design.policy), -1)
    joints = (len(columns) + 1) // 2
    message = JointTrajectory(joint_names=[name for name, _, _ in tube_lines(design)[:joints]])
    for k, efforts in enumerate(u):
        seconds, nanoseconds = divmod(round(k * design.policy.period * 1e9), 10**9)
        state = [float(column[k]) for column in columns]
        message.points.append(
            JointTrajectoryPoint(
                positions=state[:joints],
                velocities=state[joints:],
                effort=efforts.tolist(),
                time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
            )
        )
    return message
