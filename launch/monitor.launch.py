"""Publish a proved funnel and watch the running robot against it.

ros2 launch nlsid monitor.launch.py funnel:=/path/to/funnel.json
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """The publisher, which refuses what is not proved, and the monitor that waits for it."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "funnel",
                description="funnel.json; its proof, policy and model lie beside it",
            ),
            DeclareLaunchArgument(
                "nominal",
                default_value="command",
                choices=["command", "profile"],
                description="what the tube is around",
            ),
            Node(
                package="nlsid",
                executable="funnel_publisher",
                name="funnel_publisher",
                parameters=[{"funnel": LaunchConfiguration("funnel")}],
                output="screen",
            ),
            Node(
                package="nlsid",
                executable="funnel_monitor",
                name="funnel_monitor",
                parameters=[
                    {"source": "/funnel_publisher", "nominal": LaunchConfiguration("nominal")}
                ],
                output="screen",
            ),
        ]
    )
