"""A robot of ibrobot as a robot of LeRobot; importing this package registers `--robot.type=ibrobot`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from ibrobot_lerobot_program.link import ProgramLink
from lerobot.robots import Robot, RobotConfig

__all__ = ["IbrobotRobot", "IbrobotRobotConfig"]


@RobotConfig.register_subclass("ibrobot")
@dataclass
class IbrobotRobotConfig(RobotConfig):  # type: ignore[misc]  # LeRobot is not installed where types are checked
    """A robot YAML, and how to run it."""

    config: str = "so101"
    """Path of a robot YAML, or the name of a shipped one."""
    sim: bool = False
    """Whether to run its simulation instead of the hardware."""
    overrides: list[str] = field(default_factory=list)
    """Changes of the YAML, as `ibrobot launch --set` takes them."""
    use_degrees: bool = True
    """As in LeRobot's so101_follower: degrees, or -100 to 100; a gripper is 0 to 100."""
    calibration: str = ""
    """Name or path of the calibration that defines the units; by default the hardware's."""
    seed: int = 0
    """Seed of the simulation."""


class IbrobotRobot(Robot):  # type: ignore[misc]
    """Runs a robot YAML in a process with its own control process, limits and faults; a fault is an exception."""

    config_class = IbrobotRobotConfig
    name = "ibrobot"

    def __init__(self, config: IbrobotRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.link = ProgramLink(
            config.config, sim=config.sim, overrides=config.overrides, use_degrees=config.use_degrees,
            calibration=config.calibration, seed=config.seed,
        )  # fmt: skip
        self.name = self.link.robot_type
        self.cameras = dict(self.link.features.pictures)

    @cached_property
    def observation_features(self) -> dict[str, Any]:
        """The joints' positions, and the pictures of the contract."""
        return {**self.action_features, **self.link.features.pictures}

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """The joints of the contract's action, in its order."""
        return {f"{joint}.pos": float for joint in self.link.features.joints}

    @property
    def is_connected(self) -> bool:
        """Whether the run has been started."""
        return self.link.is_running

    @property
    def is_calibrated(self) -> bool:
        """True: `ibrobot feetech calibrate` or another command of the hardware calibrates it."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Start the run."""
        if self.is_connected:
            raise RuntimeError(f"{self} is already connected")
        self.link.start()

    def calibrate(self) -> None:
        """Do nothing; see `is_calibrated`."""

    def configure(self) -> None:
        """Do nothing: the robot YAML configures it."""

    def get_observation(self) -> dict[str, Any]:
        """Positions as measured now, and the newest pictures.

        Raises:
            ComponentFailed: for a fault, with its text.
        """
        values, pictures = self.link.read()
        return {**values, **pictures}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Command positions; the control process limits speed, acceleration and range.

        Joints without a position keep their last one.

        Raises:
            ComponentFailed: for an unknown feature, or a value that is no finite number; nothing is commanded then.
        """
        return self.link.act(action)

    def disconnect(self) -> None:
        """End the run; the robot comes to rest as `control.stop` of its YAML says."""
        self.link.end()
