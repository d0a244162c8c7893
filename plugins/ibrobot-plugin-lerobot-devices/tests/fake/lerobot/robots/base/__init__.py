"""A base with a gripper: its wheels have the velocities that they were sent at once, and keep them."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from lerobot.motors import Bus, Motor, MotorCalibration, MotorNormMode
from lerobot.robots import RobotConfig

AXES = ("x.vel", "y.vel", "theta.vel")
VALUES = {"nan": float("nan"), "inf": float("inf"), "huge": 1e300}


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

    @property
    def _fault(self) -> str:
        """What is wrong with the base alone: a velocity, or `missing`, `fail_read` or `fail_send`."""
        fault = self.bus.port.with_suffix(".fault")
        return fault.read_text() if fault.exists() else ""

    def _fail_if(self, what: str) -> None:
        if self._fault == what:
            raise ConnectionError("the base does not answer")

    def get_observation(self) -> dict[str, Any]:
        self._fail_if("fail_read")
        at = self.bus.read()
        found = {"gripper.pos": at["gripper"]} | {axis: at.get(axis, 0.0) for axis in AXES}
        if self._fault in VALUES:
            found["x.vel"] = VALUES[self._fault]
        elif self._fault == "missing":
            del found["x.vel"]
        return found

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self._fail_if("fail_send")
        self.bus.write({name.removesuffix(".pos"): value for name, value in action.items()})
        return action

    def stop_base(self) -> None:
        self.bus.write(dict.fromkeys(AXES, 0.0))

    def disconnect(self) -> None:
        self.bus.is_connected = False


@RobotConfig.register_subclass("fake_base")
@dataclass
class BaseConfig(RobotConfig):
    """Its config."""

    device: ClassVar[type[Base]] = Base
    port: str = field(kw_only=True)
    measures: bool = True
