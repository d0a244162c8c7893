"""A made-up arm with two cameras, and a leader: LeRobot's own commands record and move them.

LeRobot has no simulated SO-101. This one has its joints, and pictures of the size of the dataset to compare with.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = [
    f"{name}.pos" for name in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
]
CAMERAS = ("top", "wrist")
HEIGHT, WIDTH = 240, 320
"""Size of the pictures [px]."""


def positions(step: int) -> dict[str, float]:
    """Angles of the joints [rad], by LeRobot's names, at a step of 1/30 s."""
    return {name: float(np.sin(step / 30 + i)) for i, name in enumerate(JOINTS)}


class MadeUpDevice:
    """What needs no cable and no calibration."""

    _connected = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    @property
    def is_calibrated(self) -> bool:
        return True

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self._connected = False


@RobotConfig.register_subclass("made_up")
@dataclass
class MadeUpRobotConfig(RobotConfig):  # type: ignore[misc]  # LeRobot has no types
    """It has nothing to set."""


class MadeUpRobot(MadeUpDevice, Robot):  # type: ignore[misc]
    """An arm that reaches its goals at once."""

    config_class = MadeUpRobotConfig
    name = "made_up"

    def __init__(self, config: MadeUpRobotConfig) -> None:
        super().__init__(config)
        self.cameras = dict.fromkeys(CAMERAS)
        self._step = 0
        rows, columns = np.mgrid[:HEIGHT, :WIDTH]
        shifts = range(60)
        self._pictures = [
            np.stack([columns + 3 * k, 2 * rows + k, rows + columns], axis=-1).astype(np.uint8) for k in shifts
        ]

    @property
    def observation_features(self) -> dict[str, Any]:
        return {**dict.fromkeys(JOINTS, float), **dict.fromkeys(CAMERAS, (HEIGHT, WIDTH, 3))}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    def get_observation(self) -> dict[str, Any]:
        self._step += 1
        shown = {name: self._pictures[(self._step + 20 * i) % 60].copy() for i, name in enumerate(CAMERAS)}
        return {**positions(self._step), **shown}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return action


@TeleoperatorConfig.register_subclass("made_up_leader")
@dataclass
class MadeUpLeaderConfig(TeleoperatorConfig):  # type: ignore[misc]
    """It has nothing to set."""


class MadeUpLeader(MadeUpDevice, Teleoperator):  # type: ignore[misc]
    """A leader that is always in motion."""

    config_class = MadeUpLeaderConfig
    name = "made_up_leader"

    def __init__(self, config: MadeUpLeaderConfig) -> None:
        super().__init__(config)
        self._step = 0

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(JOINTS, float)

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    def get_action(self) -> dict[str, float]:
        self._step += 1
        return positions(self._step)

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
