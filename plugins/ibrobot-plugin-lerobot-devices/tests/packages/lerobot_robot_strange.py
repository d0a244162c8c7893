"""Devices of others for LeRobot, which say no unit: an arm, its leader, and a base."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from lerobot.robots import RobotConfig
from lerobot.teleoperators import TeleoperatorConfig


class Strange:
    """The arm."""

    name = "strange"
    is_calibrated = True
    calibration_fpath = Path("strange.json")
    action_features: ClassVar[dict[str, Any]] = {"pan.pos": float, "lift.pos": float, "tilt.q": float}
    observation_features = action_features

    def __init__(self, config: Any) -> None:
        self.config = config

    def connect(self, calibrate: bool = True) -> None:
        """There is nothing to connect."""

    def get_observation(self) -> dict[str, float]:
        return dict.fromkeys(self.observation_features, 0.0)

    get_action = get_observation

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        return action

    def disconnect(self) -> None:
        """There is nothing to release."""


class StrangeBase(Strange):
    """The base."""

    action_features: ClassVar[dict[str, Any]] = dict.fromkeys(("grip.pos", "x.vel", "y.vel", "theta.vel"), float)
    observation_features = action_features


@RobotConfig.register_subclass("strange_follower")
@dataclass
class StrangeConfig(RobotConfig):
    """Config of the arm."""

    device: ClassVar[type[Strange]] = Strange


@RobotConfig.register_subclass("strange_base")
@dataclass
class StrangeBaseConfig(RobotConfig):
    """Config of the base."""

    device: ClassVar[type[Strange]] = StrangeBase


@TeleoperatorConfig.register_subclass("strange_leader")
@dataclass
class StrangeLeaderConfig(TeleoperatorConfig):
    """Config of the leader."""

    device: ClassVar[type[Strange]] = Strange
