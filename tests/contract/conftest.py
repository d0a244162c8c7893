"""A robot of six joints with two executors and two cameras, and contracts of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from ibrobot_testing.contexts import ARM, GRIPPER, make_robot

from ibrobot_core.descriptors import Options
from ibrobot_core.schema import (
    ActionSpec,
    Align,
    ContractConfig,
    ControlMode,
    ExecutorConfig,
    ImageSpec,
    ObservationSpec,
    PeripheralConfig,
    RobotConfig,
)


class PictureOptions(Options):
    picture = (4, 6)


STATE = ObservationSpec("observation.state", topic="/joint_states")
TOP = ObservationSpec(
    "observation.images.top",
    peripheral="top",
    image=ImageSpec(resize=(2, 3)),
    align=Align("asof", "header", 100.0),
)
ACTIONS = (
    ActionSpec(executor="arm_position", topic="/arm/commands"),
    ActionSpec(executor="gripper_position", topic="/gripper/commands"),
)


def make_config(
    observations: Sequence[ObservationSpec] = (STATE, TOP),
    actions: Sequence[ActionSpec] = ACTIONS,
    rate_hz: float = 30.0,
) -> RobotConfig:
    executors = {
        "arm_position": ExecutorConfig("position", Options(), "arm_position", "arm", ARM),
        "gripper_position": ExecutorConfig("position", Options(), "gripper_position", "gripper", GRIPPER),
        "whole_position": ExecutorConfig("position", Options(), "whole_position", "all", GRIPPER + ARM),
    }
    peripherals = {
        "top": PeripheralConfig("webcam", PictureOptions(), "top", "camera"),
        "wrist": PeripheralConfig("webcam", Options(), "wrist", "camera"),
        "chest": PeripheralConfig("gyro", Options(), "chest", "imu"),
    }
    return RobotConfig(
        robot=make_robot(),
        executors=executors,
        control_modes={"idle": ControlMode(())},
        default_control_mode="idle",
        peripherals=peripherals,
        contract=ContractConfig(rate_hz=rate_hz, observations=tuple(observations), actions=tuple(actions)),
    )


@pytest.fixture(name="make_config", scope="session")
def make_config_fixture() -> Callable[..., Any]:
    return make_config
