"""What rclpy records of a run over the wire is what the run's own bag has."""

from __future__ import annotations

from ibrobot_core.api import CompressedImage  # noqa: F401

TOPICS = {"/joint_states": "sensor_msgs/msg/JointState", "/arm/commands": "std_msgs/msg/Float64MultiArray"}
