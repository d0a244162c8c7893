"""A base with a gripper: its wheels have the velocities that they were sent at once."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from lerobot.motors import Bus, Motor, MotorCalibration, MotorNormMode
from lerobot.robots import RobotConfig

AXES = ("x.vel", "y.vel", "theta.vel")


class Base:
    """The robot."""

    name = "base"

    def __init__(self, config: Any) -> None:
        self.config = config
        motors = {"gripper": Motor(1, "sts3215", MotorNormMode.RANGE_0_100)}
        self.bus = Bus(config.port, motors, {"gripper": MotorCalibration(0, 700, 3300)})
        self.is_calibrated = True
        self.calibration_fpath = Path("base.json")
        self.action_features: dict[str, Any] = dict.fromkeys(("gripper.pos", *AXES), float)
        measured = AXES if config.measures else AXES[:2]
        self.observation_features: dict[str, Any] = dict.fromkeys(("gripper.pos", *measured), float)

    def connect(self, calibrate: bool = True) -> None:
        self.bus.connect()

    def get_observation(self) -> dict[str, Any]:
        at = self.bus.read()
        return {"gripper.pos": at["gripper"]} | {axis: at.get(axis, 0.0) for axis in AXES}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self.bus.write({name.removesuffix(".pos"): value for name, value in action.items()})
        return action

    def disconnect(self) -> None:
        self.bus.is_connected = False


@RobotConfig.register_subclass("fake_base")
@dataclass
class BaseConfig(RobotConfig):
    """Its config."""

    device: ClassVar[type[Base]] = Base
    port: str = field(kw_only=True)
    measures: bool = True
