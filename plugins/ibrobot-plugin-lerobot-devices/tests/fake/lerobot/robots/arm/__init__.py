"""A robot of six joints: degrees, shares of the range, and one that is reversed."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import torch

from lerobot.motors import Bus, Motor, MotorCalibration, MotorNormMode
from lerobot.robots import RobotConfig

MODES = {
    "shoulder_pan": MotorNormMode.DEGREES,
    "shoulder_lift": MotorNormMode.RANGE_M100_100,
    "elbow_flex": MotorNormMode.RANGE_M100_100,
    "wrist_flex": MotorNormMode.DEGREES,
    "wrist_roll": MotorNormMode.DEGREES,
    "gripper": MotorNormMode.RANGE_0_100,
}


def make_bus(port: str) -> Bus:
    """The motors of the arm."""
    motors = {name: Motor(i, "sts3215", mode) for i, (name, mode) in enumerate(MODES.items(), 1)}
    calibration = {name: MotorCalibration(int(name == "elbow_flex"), 700, 3300) for name in MODES}
    return Bus(port, motors, calibration)


class Arm:
    """The robot."""

    name = "arm"

    def __init__(self, config: Any) -> None:
        self.config = config
        self.bus = make_bus(config.port)
        self.calibration_fpath = Path("arm.json")
        self.action_features: dict[str, Any] = {f"{name}.pos": float for name in MODES}
        self.observation_features: dict[str, Any] = {**self.action_features, "front": (480, 640, 3)}

    @property
    def is_calibrated(self) -> bool:
        return self.config.id is not None

    def connect(self, calibrate: bool = True) -> None:
        self.bus.connect()

    def get_observation(self) -> dict[str, Any]:
        found = {f"{name}.pos": value for name, value in self.bus.read().items()}
        fault = self.bus.port.with_suffix(".fault")
        return dict.fromkeys(found, float("nan")) if fault.exists() and fault.read_text() == "nan" else found

    def send_action(self, action: dict[str, float]) -> "dict[str, float] | torch.Tensor":
        self.bus.write({name.removesuffix(".pos"): value for name, value in action.items()})
        return action

    def disconnect(self) -> None:
        if self.config.disable_torque_on_disconnect:
            self.bus.disable_torque()
        self.bus.is_connected = False


@RobotConfig.register_subclass("fake_arm")
@dataclass
class ArmConfig(RobotConfig):
    """Its config."""

    device: ClassVar[type[Arm]] = Arm
    port: str = field(kw_only=True)
    disable_torque_on_disconnect: bool = True
    gain: int | None = None
    cameras: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.gain is not None and self.gain < 0:
            raise ValueError("gain must not be negative")
