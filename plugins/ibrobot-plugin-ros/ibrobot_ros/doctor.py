"""What `ibrobot doctor` says of the ROS of this machine."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_core.api import Check, MissingDependency
from ibrobot_core.app import ComponentFailed
from ibrobot_ros.installation import REMEDY, find_interpreter
from ibrobot_ros.options import RosInstallation
from ibrobot_ros.process import NodeProcess

_MISSING = {
    "control_msgs": "the actions of executors need it: apt install ros-jazzy-control-msgs",
    "tf2_msgs": "/tf and /tf_static need it: apt install ros-jazzy-tf2-msgs",
    "std_srvs": "services need it: apt install ros-jazzy-std-srvs",
    "ibrobot_msgs": "/robot_status needs it: build it in a workspace, and set ros.setup to its install/setup.bash",
}


def checks() -> Iterator[Check]:
    """One line for the ROS that was found, and one for each package of messages that it lacks."""
    options = RosInstallation()
    try:
        interpreter = find_interpreter(options)
        node = NodeProcess(options, "ibrobot_doctor", probe=True)
    except (MissingDependency, ComponentFailed) as error:
        problem = error.missing if isinstance(error, MissingDependency) else str(error)
        yield Check("ros", False, problem, REMEDY, matters=False)
        return
    node.close()
    yield Check("ros", True, f"{node.hello}, rclpy {node.hello.rclpy} ({interpreter.found})")
    for name, remedy in _MISSING.items():
        if name not in node.hello.interfaces:
            yield Check(f"ros {name}", False, "not installed", remedy, matters=False)
