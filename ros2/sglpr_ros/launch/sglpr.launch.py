"""Starts the node: ros2 launch sglpr_ros sglpr.launch.py parameters:=my.yaml"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The node, with a file of parameters."""
    usual = str(Path(get_package_share_directory("sglpr_ros")) / "config" / "sglpr.yaml")
    return LaunchDescription(
        [
            DeclareLaunchArgument("parameters", default_value=usual, description="File of parameters."),
            Node(
                package="sglpr_ros",
                executable="sglpr",
                name="sglpr",
                output="screen",
                parameters=[LaunchConfiguration("parameters")],
            ),
        ]
    )
