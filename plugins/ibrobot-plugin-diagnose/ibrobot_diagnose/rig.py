"""The rig at a time: a still of each camera with the pose of the arm, rates, calibration and versions."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_diagnose.pictures import png, read_png

type Floats = NDArray[np.float64]

_FARTHEST = 1e4
"""No joint is turned farther [rad]."""
STILL_WIDTH = 320
"""Width of stills [pixels]; between this and twice as much."""


@attrs.frozen(eq=False)
class Still:
    """A picture with the pose in which the arm was."""

    picture: NDArray[np.uint8]
    """Shape (H, W, 3)."""
    pose: Floats
    """Positions of the joints [rad], shape (J,); NaN where unknown."""
    moving: NDArray[np.bool_] | None = None
    """Where something may move against the camera: the arm, for a camera that stands; shape (H, W). None if unknown."""


@attrs.frozen(eq=False)
class RigCamera:
    """A camera of a rig."""

    size: tuple[int, int]
    """Height and width of its pictures [pixels]."""
    stills: tuple[Still, ...]
    rate_hz: float | None = None
    settings: Mapping[str, Any] = attrs.field(factory=dict)
    """Its options in the robot YAML without the device, e.g. exposure."""
    focal: float | None = None
    """Focal length in relation to the width of the pictures; None if unknown."""
    stands: bool | None = None
    """Whether it stands still beside the arm, and is not on it; None if unknown."""


@attrs.frozen(eq=False)
class Rig:
    """What a rig was at a time."""

    robot: str
    taken: str
    """Date, ISO 8601; empty if unknown."""
    joints: tuple[str, ...]
    cameras: Mapping[str, RigCamera]
    """Key of an observation -> its camera."""
    loop_hz: float | None = None
    """Rate at which joint states come."""
    asked_hz: float | None = None
    """Rate that the robot YAML asks for."""
    calibration: Mapping[str, Mapping[str, Mapping[str, Any]]] = attrs.field(factory=dict)
    """Name of the hardware -> joint -> numbers of its calibration."""
    versions: Mapping[str, str] = attrs.field(factory=dict)
    """Package -> version."""
    fingerprint: str = ""
    """That of the contract."""
    leaders: Mapping[str, Mapping[str, float]] = attrs.field(factory=dict)
    """Teleoperation device -> joint -> its position less that of the robot, at rest [rad]."""
    conditions: tuple[Mapping[str, Any], ...] = ()
    """Abnormal conditions of joints, as fields of `Condition`."""
    absent: Mapping[str, str] = attrs.field(factory=dict)
    """Sensor that this machine cannot run -> why."""
    notes: tuple[str, ...] = ()
    """What could not be done, and why; not stored."""

    def facts(self) -> dict[str, Any]:
        """The rig as a JSON object."""
        return {
            "robot": self.robot, "taken": self.taken, "joints": list(self.joints), "loop_hz": self.loop_hz,
            "asked_hz": self.asked_hz, "calibration": self.calibration, "versions": dict(self.versions),
            "fingerprint": self.fingerprint, "leaders": {name: dict(each) for name, each in self.leaders.items()},
            "cameras": {key: _camera_facts(each) for key, each in self.cameras.items()},
        }  # fmt: skip

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Rig:
        """The rig in the facts of a card, which may come from anywhere.

        Raises:
            ValueError, KeyError, TypeError, AttributeError: if they are damaged.
        """
        joints = tuple(str(each) for each in facts["joints"])
        if len(set(joints)) != len(joints):
            raise ValueError(f"a joint is listed twice in {', '.join(joints)}")
        if taken := str(facts["taken"]):
            datetime.fromisoformat(taken)
        calibration = {
            str(name): {str(joint): _numbers(numbers, str(joint)) for joint, numbers in each.items()}
            for name, each in facts["calibration"].items()
        }
        return cls(
            str(facts["robot"]), taken, joints,
            {str(key): _camera_of(each, len(joints)) for key, each in facts["cameras"].items()},
            _number(facts["loop_hz"], "loop_hz"), _number(facts["asked_hz"], "asked_hz"), calibration,
            {str(name): str(each) for name, each in facts["versions"].items()}, str(facts["fingerprint"]),
            {
                str(name): {str(joint): _finite(value, str(joint)) for joint, value in each.items()}
                for name, each in facts["leaders"].items()
            },
        )  # fmt: skip


def _finite(value: Any, name: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{name}: {value!r} is not a finite number")
    return number


def _numbers(numbers: Mapping[str, Any], joint: str) -> dict[str, Any]:
    """The numbers of a joint's calibration."""
    for key in ("homing_offset", "range_min", "range_max"):
        if type(numbers[key]) is not int:
            raise ValueError(f"calibration: {joint}: {key}: {numbers[key]!r} is not a whole number")
    return dict(numbers)


def _number(value: Any, name: str) -> float | None:
    number = None if value is None else _finite(value, name)
    if number is not None and number <= 0:
        raise ValueError(f"{name}: {value!r} is not above 0")
    return number


def _camera_facts(camera: RigCamera) -> dict[str, Any]:
    return {
        "size": list(camera.size), "rate_hz": camera.rate_hz, "settings": dict(camera.settings),
        "focal": camera.focal, "stands": camera.stands,
        "stills": [
            {
                "picture": base64.b64encode(png(each.picture)).decode(),
                "pose": [None if math.isnan(value) else float(f"{value:.6g}") for value in each.pose.tolist()],
            }
            for each in camera.stills
        ],
    }  # fmt: skip


def _camera_of(facts: Mapping[str, Any], joints: int) -> RigCamera:
    stills = []
    for each in facts["stills"]:
        pose = np.array([math.nan if value is None else _finite(value, "pose") for value in each["pose"]])
        if pose.shape != (joints,):
            raise ValueError(f"the pose of a still has {counted(pose.size, 'joint')}, must have {joints}")
        if np.abs(pose[np.isfinite(pose)]).max(initial=0.0) > _FARTHEST:
            raise ValueError(f"the pose of a still is beyond {_FARTHEST:g} rad")
        stills.append(Still(read_png(base64.b64decode(each["picture"], validate=True)), pose))
    if not stills:
        raise ValueError("a camera has no still")
    height, width = (int(each) for each in facts["size"])
    if height <= 0 or width <= 0:
        raise ValueError(f"the size of a camera, {height} x {width}, is not above 0")
    stands = facts["stands"]
    if not isinstance(stands, bool | None):
        raise ValueError(f"stands must be true, false or null, not {stands!r}")
    focal = _number(facts["focal"], "focal")
    return RigCamera(
        (height, width), tuple(stills), _number(facts["rate_hz"], "rate_hz"), dict(facts["settings"]), focal, stands
    )
