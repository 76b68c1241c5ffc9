"""Record the excitation and response topics of one trial.

ros2 launch nlsid record.launch.py topics:='[/cmd_vel, /odom]' bag:=/path/to/trial_01
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """The recorder, started with the topics and the folder given."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "topics", description="YAML list of the topics to record, as '[/cmd_vel, /odom]'"
            ),
            DeclareLaunchArgument("bag", description="folder of the new bag; must not exist"),
            Node(
                package="nlsid",
                executable="trajectory_recorder",
                name="trajectory_recorder",
                parameters=[
                    {"topics": LaunchConfiguration("topics"), "bag": LaunchConfiguration("bag")}
                ],
                output="screen",
            ),
        ]
    )
