"""A client for scripts: the classes and methods of pymoveit2, for a robot that `ibrobot launch` runs.

`MoveIt2`, `GripperInterface` and `MoveIt2Servo` have pymoveit2's signatures. `Node` connects to the robot; the module
`rclpy` has the few functions that such scripts call.
"""

from ibrobot_planning.client import robots
from ibrobot_planning.client.gripper import GripperCommand, GripperInterface, MoveIt2Gripper
from ibrobot_planning.client.moveit2 import MoveIt2, MoveIt2State, MoveItErrorCodes
from ibrobot_planning.client.node import LocalNode, Node
from ibrobot_planning.client.rclpy import ReentrantCallbackGroup
from ibrobot_planning.client.servo import MoveIt2Servo

__all__ = [
    "GripperCommand", "GripperInterface", "LocalNode", "MoveIt2", "MoveIt2Gripper", "MoveIt2Servo", "MoveIt2State",
    "MoveItErrorCodes", "Node", "ReentrantCallbackGroup", "robots",
]  # fmt: skip
