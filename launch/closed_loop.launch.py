"""Track a proved funnel's plan and watch it, on the simulated plant or on a robot.

ros2 launch nlsid closed_loop.launch.py funnel:=/path/to/funnel.json highest:=0.4
    plant:=true model:=/path/to/model.json
ros2 service call /tracking_controller/start std_srvs/srv/Trigger
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Publisher, controller and monitor, joined by the controller's announcement."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("funnel", description="funnel.json; its proof lies beside it"),
            DeclareLaunchArgument("lowest", default_value="0.0", description="least input"),
            DeclareLaunchArgument("highest", description="greatest input the robot may get"),
            DeclareLaunchArgument(
                "plant", default_value="false", description="simulate the robot by its model"
            ),
            DeclareLaunchArgument(
                "model", default_value="", description="model.json, for the plant"
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
                executable="tracking_controller",
                name="tracking_controller",
                parameters=[
                    {
                        "lowest": _number("lowest"),
                        "highest": _number("highest"),
                    }
                ],
                output="screen",
            ),
            Node(
                package="nlsid",
                executable="funnel_monitor",
                name="funnel_monitor",
                parameters=[
                    {
                        "nominal": "profile",
                        "controller": "tracking_controller",
                        "stop_service": "tracking_controller/stop",
                    }
                ],
                output="screen",
            ),
            Node(
                package="nlsid",
                executable="plant",
                name="plant",
                condition=IfCondition(LaunchConfiguration("plant")),
                parameters=[
                    {
                        "model": LaunchConfiguration("model"),
                        "noise": 0.002,
                    }
                ],
                output="screen",
            ),
        ]
    )


def _number(name: str) -> ParameterValue:
    """A launch argument as a float parameter: ROS keeps 1 and 1.0 apart."""
    return ParameterValue(LaunchConfiguration(name), value_type=float)
