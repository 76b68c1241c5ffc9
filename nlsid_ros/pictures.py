"""A funnel as RViz, Foxglove and trajectory tools show it."""

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from bags.monitoring.documents import ProvedFunnel
from nlsid_core._types import FloatArray

LINE = 0.005  # m, width of the lines
NOMINAL, EDGE = ColorRGBA(r=0.2, g=0.4, b=1.0, a=1.0), ColorRGBA(r=0.2, g=0.7, b=0.2, a=1.0)


def nominal_output(proved: ProvedFunnel) -> FloatArray:
    """(N,): y_k = C x_k + D u_k + c of the plan, in the output's unit."""
    model, policy = proved.model, proved.policy
    return policy.x[:, 0] + model.D * policy.u + model.c


def tube_markers(proved: ProvedFunnel, frame: str) -> MarkerArray:
    """The plan and the tube's edges over time: 1 m along x is 1 s, along y one output unit."""
    nominal, width = nominal_output(proved), proved.funnel.half_width
    lines = ((nominal, NOMINAL), (nominal + width, EDGE), (nominal - width, EDGE))
    markers = []
    for number, (values, color) in enumerate(lines):
        marker = Marker(ns="tube", id=number, type=Marker.LINE_STRIP, action=Marker.ADD)
        marker.header.frame_id = frame
        marker.pose.orientation.w = 1.0
        marker.scale.x, marker.color = LINE, color
        marker.points = [
            Point(x=k * proved.policy.period, y=float(value)) for k, value in enumerate(values)
        ]
        markers.append(marker)
    return MarkerArray(markers=markers)


def nominal_trajectory(proved: ProvedFunnel) -> JointTrajectory:
    """The plan: the output as position, the input as effort."""
    message = JointTrajectory(joint_names=[proved.model.y.name])
    plan = zip(nominal_output(proved), proved.policy.u, strict=True)
    for k, (output, u) in enumerate(plan):
        seconds, nanoseconds = divmod(round(k * proved.policy.period * 1e9), 10**9)
        message.points.append(
            JointTrajectoryPoint(
                positions=[float(output)],
                effort=[float(u)],
                time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
            )
        )
    return message
