"""A leader with the joints of the arm, and a device that commands a tool."""

# mypy: disable-error-code="misc"

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from lerobot.robots.arm import MODES, make_bus
from lerobot.teleoperators import TeleoperatorConfig


class Leader:
    """The leader."""

    name = "leader"
    is_calibrated = True

    def __init__(self, config: Any) -> None:
        self.config = config
        self.bus = make_bus(config.port)
        self.calibration_fpath = Path("leader.json")
        self.action_features: dict[str, Any] = {f"{name}.pos": float for name in MODES}

    def connect(self, calibrate: bool = True) -> None:
        self.bus.connect()

    def get_action(self) -> dict[str, float]:
        return {f"{name}.pos": value for name, value in self.bus.read().items()}

    def disconnect(self) -> None:
        self.bus.is_connected = False


@TeleoperatorConfig.register_subclass("fake_leader")
@dataclass
class LeaderConfig(TeleoperatorConfig):
    """Its config."""

    device: ClassVar[type[Leader]] = Leader
    port: str = field(kw_only=True)


class Stick:
    """A device that commands a tool."""

    name = "stick"
    is_calibrated = True
    calibration_fpath = Path("stick.json")
    action_features: ClassVar[dict[str, Any]] = {"delta_x": float, "delta_y": float}

    def __init__(self, config: Any) -> None:
        self.config = config

    def connect(self, calibrate: bool = True) -> None:
        """There is nothing to connect."""

    def get_action(self) -> dict[str, float]:
        return {"delta_x": 0.0, "delta_y": 0.0}

    def disconnect(self) -> None:
        """There is nothing to release."""


@TeleoperatorConfig.register_subclass("fake_stick")
@dataclass
class StickConfig(TeleoperatorConfig):
    """Its config."""

    device: ClassVar[type[Stick]] = Stick
