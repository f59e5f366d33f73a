"""A skin in the graph: ``ros2 launch skinware_msgs skin.launch.py bus:=can0``.

Runs the commands of Skinware, which are looked for in PATH (``pip install 'skinware[ros2]'``).
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description():
    """A driver and its bridge; each is started again when it ends."""
    arguments = {
        "driver": "roboskin",
        "bus": "virtual",
        "namespace": "default",
        "rate": "20",
        "rmw": "dds",
    }
    of = {name: LaunchConfiguration(name) for name in arguments}
    driver = ["skin-driver", "--driver", of["driver"], "--bus", of["bus"], "--namespace", of["namespace"]]
    bridge = ["skin-bridge", "ros2", "--namespace", of["namespace"], "--rate", of["rate"], "--rmw", of["rmw"]]
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value) for name, value in arguments.items()),
            *(ExecuteProcess(cmd=command, output="screen", respawn=True) for command in (driver, bridge)),
        ]
    )
