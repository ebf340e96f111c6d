"""Starts slag-ros in front of a robot's slag-edge.

ros2 launch slag.launch.py robot:=http://127.0.0.1:7734 scene_frame:=map
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

# Each is the flag of the same name; `slag-ros --help` explains them.
ARGUMENTS = {
    "robot": "http://127.0.0.1:7734",
    "name": "slag",
    "scene_frame": "map",
    "base_frame": "base_link",
    "position": "tf",
    "position_period": "1.0",
    "limit": "10",
    "points": "3500",
    "robot_radius": "0.3",
    "sensor_height": "0.4",
    "reach": "0.8",
    "send_goals": "none",
}


def generate_launch_description():
    command = ["slag-ros"]
    for name in ARGUMENTS:
        command += ["--" + name.replace("_", "-"), LaunchConfiguration(name)]
    declared = [DeclareLaunchArgument(name, default_value=value) for name, value in ARGUMENTS.items()]
    return LaunchDescription([*declared, ExecuteProcess(cmd=command, output="screen", respawn=True)])
