"""A teleoperation device of ibrobot as a teleoperator of LeRobot; importing this registers `--teleop.type=ibrobot`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from ibrobot_lerobot_program.teleop import ProgramTeleop
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

__all__ = ["IbrobotTeleoperator", "IbrobotTeleoperatorConfig"]


@TeleoperatorConfig.register_subclass("ibrobot")
@dataclass
class IbrobotTeleoperatorConfig(TeleoperatorConfig):  # type: ignore[misc]  # LeRobot is missing where types are checked
    """A device of a robot YAML."""

    config: str = "so101"
    """Path of a robot YAML, or the name of a shipped one."""
    device: str = "leader"
    """Name of the device in its section `teleoperation`."""
    pose: str = ""
    """Named pose at which a robot stands that is not one of ibrobot's."""
    sim: bool = False
    """Whether the YAML is loaded for simulation."""
    overrides: list[str] = field(default_factory=list)
    """Changes of the YAML, as `ibrobot launch --set` takes them."""
    use_degrees: bool = True
    """As for the robot."""
    calibration: str = ""
    """As for the robot."""


class IbrobotTeleoperator(Teleoperator):  # type: ignore[misc]
    """A device of ibrobot, with its deadman: the command stays while it is released."""

    config_class = IbrobotTeleoperatorConfig
    name = "ibrobot"

    def __init__(self, config: IbrobotTeleoperatorConfig) -> None:
        super().__init__(config)
        self.config = config
        self.device = ProgramTeleop(
            config.config, config.device, pose=config.pose, sim=config.sim, overrides=config.overrides,
            use_degrees=config.use_degrees, calibration=config.calibration,
        )  # fmt: skip

    @cached_property
    def action_features(self) -> dict[str, Any]:
        """The joints of the contract's action, in its order."""
        return {f"{joint}.pos": float for joint in self.device.features.joints}

    @property
    def feedback_features(self) -> dict[str, Any]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the device is open."""
        return self.device.is_connected

    @property
    def is_calibrated(self) -> bool:
        """True: the commands of its plugin calibrate a device."""
        return True

    def connect(self, calibrate: bool = True) -> None:
        """Open the device."""
        self.device.connect()

    def calibrate(self) -> None:
        """Do nothing; see `is_calibrated`."""

    def configure(self) -> None:
        """Do nothing: the robot YAML configures it."""

    def get_action(self) -> dict[str, Any]:
        """The present command."""
        return self.device.read()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Release the device."""
        self.device.disconnect()
