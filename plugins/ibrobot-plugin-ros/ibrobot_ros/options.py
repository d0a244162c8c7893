"""The section `ros`, and how the ROS of a machine is found."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import MESSAGE_TYPES, Options, did_you_mean, documented, option

NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")
"""A full name of ROS."""
PROFILES = ("default", "sensor_data", "latched")


def _check_namespace(instance: object, attribute: attrs.Attribute[str], value: str) -> None:
    if value and not NAME.fullmatch("/" + value.strip("/")):
        raise ValueError(f"namespace {value!r} is not a ROS 2 name, e.g. robot1 or lab/robot1")


def check_name(name: str) -> None:
    """Check that a name is a full name of ROS.

    Raises:
        ValueError: if it is not.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not a full ROS 2 name: letters, digits and _ after slashes, e.g. /joint_states")


def check_topic(instance: object, attribute: attrs.Attribute[str], value: str) -> None:
    """Check an option that names a topic."""
    check_name(value)


def _check_listed(instance: object, attribute: attrs.Attribute[Any], value: str | tuple[str, ...]) -> None:
    if isinstance(value, str):
        if value != "all":
            raise ValueError(f"must be all, or a list of names, got {value!r}")
        return
    for name in value:
        check_name(name)


def _check_subscribed(instance: object, attribute: attrs.Attribute[Any], value: Mapping[str, str]) -> None:
    for topic, type_name in value.items():
        check_name(topic)
        if type_name not in MESSAGE_TYPES:
            known = did_you_mean(type_name, list(MESSAGE_TYPES), "the types are")
            raise ValueError(f"{topic}: unknown message type {type_name!r}{known}")


def _check_qos(instance: object, attribute: attrs.Attribute[Any], value: Mapping[str, str]) -> None:
    for topic, name in value.items():
        check_name(topic)
        if name not in PROFILES:
            raise ValueError(f"{topic}: unknown profile {name!r}{did_you_mean(name, PROFILES, 'the profiles are')}")


@documented
@attrs.frozen
class RosInstallation(Options):
    """The ROS to use, and the part of its network to reach."""

    python: str | None = option(
        None,
        help="interpreter that has rclpy, e.g. a virtual environment's bin/python; by default this one, then that of "
        "the sourced ROS, then that of /opt/ros",
    )
    setup: Path | None = option(
        None, help="script that sets up ROS, e.g. /opt/ros/jazzy/setup.bash, or a workspace's install/setup.bash"
    )
    domain: int | None = option(None, ge=0, le=232, help="ROS domain; by default ROS_DOMAIN_ID, else 0")
    discovery: str = option(
        "localhost",
        choices=("localhost", "subnet", "system_default"),
        help="which nodes are found: those of this machine, or those of the network; everyone there may then move the "
        "robot. system_default leaves it to the environment",
    )
    rmw: str | None = option(
        None, help="ROS middleware, e.g. rmw_cyclonedds_cpp; by default RMW_IMPLEMENTATION, else ROS's own default"
    )


@documented
@attrs.frozen
class RosOptions(RosInstallation):
    """Options of the section `ros`."""

    name: str = option("ibrobot", help="name of the node")
    namespace: str = option(
        "", validator=_check_namespace, help="prefix of all names in ROS but those of /tf and /clock"
    )
    publish: str | tuple[str, ...] = option(
        "all", validator=_check_listed, help="topics of this robot to publish in ROS: all, or a list"
    )
    subscribe: Mapping[str, str] = option(
        factory=dict,
        validator=_check_subscribed,
        help="topic of ROS -> its type, for what the run receives, e.g. {/cmd_pose: geometry_msgs/msg/PoseStamped}",
    )
    rate_hz: float = option(
        500.0, unit="Hz", gt=0, help="highest rate of each received topic; what exceeds it is dropped and counted"
    )
    qos: Mapping[str, str] = option(
        factory=dict,
        validator=_check_qos,
        help="topic -> default, sensor_data or latched, where another profile is needed than that of its type",
    )
    clock: bool | None = option(None, help="whether /clock is published, for use_sim_time; by default in simulation")
    services: str | tuple[str, ...] = option(
        "all", validator=_check_listed, help="services of this robot to offer in ROS: all, or a list"
    )
    actions: bool = option(True, help="whether the executors that take goals are action servers in ROS")
    gripper_action: str = option(
        "GripperCommand",
        choices=("GripperCommand", "ParallelGripperCommand"),
        help="type of the action of executors that take a position",
    )

    def offers(self, service: str) -> bool:
        """Whether a service of the run is offered in ROS."""
        return self.services == "all" or service in self.services


def _check_controller(instance: object, attribute: attrs.Attribute[str], value: str) -> None:
    check_name("/" + value.strip("/"))


@documented
@attrs.frozen(kw_only=True)
class Ros2ControlOptions(RosInstallation):
    """Options of `type: ros2_control`."""

    controller: str = option(
        validator=_check_controller, help="controller that takes the commands, e.g. arm_controller"
    )
    command: str = option(
        "positions",
        choices=("positions", "trajectory"),
        help="positions: CONTROLLER/commands, as of forward_command_controller, in the order of these joints; "
        "trajectory: CONTROLLER/joint_trajectory, as of joint_trajectory_controller",
    )
    states: str = option("/joint_states", validator=check_topic, help="topic of the joint states")
    stamp: str = option(
        "header",
        choices=("header", "receive"),
        help="time of a state: its own stamp, or when it comes, for controllers with another clock",
    )
