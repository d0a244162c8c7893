"""Calibrations: zero and range of each joint, in the file formats of LeRobot and IB-Robot, which count servo ticks."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import attrs

from ibrobot_core.api import CalibrationError

VERSION = 2
"""Version of the companion file."""
ZERO_AT = ("pose", "range")
"""Positions of 0 rad: the pose that was set by hand at calibration, or the middle of each joint's calibrated range."""


@attrs.frozen
class JointCalibration:
    """The calibration of one joint, with LeRobot's field names (`MotorCalibration`)."""

    TICKS_PER_TURN: ClassVar[int] = 4096
    """Encoder positions per turn of a servo (12 bit)."""
    MAX_HOMING_OFFSET: ClassVar[int] = 2047
    """Greatest homing offset that a servo can store (sign and 11 bits)."""

    id: int
    """Id of the servo."""
    drive_mode: int
    """1 if radians decrease as ticks increase."""
    homing_offset: int
    """Offset that the servo subtracts from its encoder position [ticks], -2047 to 2047."""
    range_min: int
    """Least reported position [ticks], 0 to 4094."""
    range_max: int
    """Greatest reported position [ticks], above `range_min`, at most 4095."""
    zero_at: str = "pose"
    """Position of 0 rad: one of `ZERO_AT`. Not present in LeRobot's files."""
    closed_at: float | None = None
    """Lower limit [rad] if the hardware anchors the joint at its closed end; set only in recordings."""

    def __attrs_post_init__(self) -> None:
        for name, value in self.numbers().items():
            if type(value) is not int:
                raise ValueError(f"{name}: must be a whole number, not {value!r}")
        if self.zero_at not in ZERO_AT:
            raise ValueError(f"zero_at: must be one of {', '.join(ZERO_AT)}, not {self.zero_at!r}")
        if self.closed_at is not None and not (isinstance(self.closed_at, float) and math.isfinite(self.closed_at)):
            raise ValueError(f"closed_at: must be an angle [rad] or nothing, not {self.closed_at!r}")
        if not 0 <= self.id <= 253:
            raise ValueError(f"id: must be 0 to 253, not {self.id}")
        if self.drive_mode not in (0, 1):
            raise ValueError(f"drive_mode: must be 0 or 1, not {self.drive_mode}")
        most = self.MAX_HOMING_OFFSET
        if abs(self.homing_offset) > most:
            raise ValueError(
                f"homing_offset: must be -{most} to {most}, not {self.homing_offset}; "
                "the servo's horn sits so that the joint's middle is at the encoder's end (0/4095): "
                "mount it half a turn on, and re-run the calibration"
            )
        last = self.TICKS_PER_TURN - 1
        for name in ("range_min", "range_max"):
            if not 0 <= getattr(self, name) <= last:
                raise ValueError(
                    f"{name}: must be 0 to {last}, not {getattr(self, name)}; a range beyond that crosses the "
                    "encoder's end (0/4095): re-run the calibration with the joint's middle in the middle"
                )
        if self.range_min >= self.range_max:
            raise ValueError(f"range_min: must be below range_max ({self.range_max}), not {self.range_min}")

    @property
    def inverted(self) -> bool:
        """Whether radians decrease as ticks increase."""
        return self.drive_mode == 1

    @property
    def range_middle(self) -> float:
        """The middle of the calibrated range [ticks]: 0 degrees in LeRobot."""
        return (self.range_min + self.range_max) / 2

    def numbers(self) -> dict[str, int]:
        """The numbers in the form of LeRobot's file."""
        return {name: getattr(self, name) for name in _NUMBERS}

    def zero(self, lower: float | None = None) -> float:
        """The tick of 0 rad: the middle of the encoder or of the range, depending on `zero_at`.

        Args:
            lower: lower limit [rad] of a joint that is anchored at its closed end instead, such as a gripper. The
                closed end is at `range_min`, or at `range_max` if inverted.
        """
        if lower is None:
            return self.TICKS_PER_TURN / 2 if self.zero_at == "pose" else self.range_middle
        ticks = lower * self.TICKS_PER_TURN / (2 * math.pi)
        return self.range_max + ticks if self.inverted else self.range_min - ticks

    def ends(self, lower: float | None = None) -> tuple[float, float]:
        """The angles at the ends of the calibrated range [rad], the lesser one first; see `zero` for `lower`."""
        zero = self.zero(lower)
        first, last = ((end - zero) * 2 * math.pi / self.TICKS_PER_TURN for end in (self.range_min, self.range_max))
        return (-last, -first) if self.inverted else (first, last)


_NUMBERS = tuple(field.name for field in attrs.fields(JointCalibration) if field.name not in ("zero_at", "closed_at"))
_KEYS = ", ".join(_NUMBERS)
_NUMBER = re.compile("[0-9]{1,3}")
"""Key of a servo in IB-Robot's file."""


@attrs.frozen
class Calibration:
    """A whole arm."""

    joints: Mapping[str, JointCalibration]
    """Joints by name, in the order of the servos."""
    robot: str = ""
    """Name of the arm."""
    date: str = ""
    """Date of the calibration: ISO 8601, UTC."""
    adapter: str = ""
    """USB serial number of the adapter used for the calibration; empty if it has none."""
    version: int = VERSION
    """Version of the companion file's layout."""
    path: Path | None = None
    """The file it was loaded from."""

    def __attrs_post_init__(self) -> None:
        owners: dict[int, str] = {}
        for name, joint in self.joints.items():
            if (owner := owners.setdefault(joint.id, name)) != name:
                raise ValueError(f"{name}: id: servo {joint.id} belongs to {owner} already")
        if len(different := {joint.zero_at for joint in self.joints.values()}) > 1:
            raise ValueError(f"zero_at: must be the same for all joints, not {' and '.join(sorted(different))}")

    @property
    def zero_at(self) -> str:
        """Position of 0 rad, the same for all joints: one of `ZERO_AT`."""
        return next((joint.zero_at for joint in self.joints.values()), "pose")

    def with_zero_at(self, zero_at: str) -> Calibration:
        """A copy with another position of 0 rad."""
        return attrs.evolve(
            self, joints={name: attrs.evolve(joint, zero_at=zero_at) for name, joint in self.joints.items()}
        )

    def numbers(self) -> dict[str, dict[str, int]]:
        """The numbers in the form of LeRobot's file."""
        return {name: joint.numbers() for name, joint in self.joints.items()}

    def snapshot(self) -> dict[str, dict[str, Any]]:
        """The fields of `JointCalibration` by joint, without `closed_at`, which the hardware sets."""
        return {name: {**joint.numbers(), "zero_at": joint.zero_at} for name, joint in self.joints.items()}

    def check_ranges(self, limits: Mapping[str, tuple[float, float]], closed_ends: Mapping[str, float | None]) -> None:
        """Check that each range fits the limits of its joint: it has half of them, and is at most twice as large.

        Args:
            limits: joint -> lower and upper limit [rad].
            closed_ends: joint -> its lower limit if it is anchored at its closed end, see `JointCalibration.zero`.

        Raises:
            CalibrationError: if one does not.
        """
        for name, (lower, upper) in limits.items():
            first, last = self.joints[name].ends(closed_ends.get(name)) if name in self.joints else (lower, upper)
            if min(last, upper) - max(first, lower) < (upper - lower) / 2 or last - first > 2 * (upper - lower):
                raise CalibrationError(
                    f"{self.path}: {name}: its range, {first:.2f} to {last:.2f} rad, does not fit its limits, "
                    f"{lower:g} to {upper:g} rad: check that it is that of this arm, or calibrate again"
                )

    def fingerprint(self) -> str:
        """SHA-256 of the numbers, 64 hexadecimal digits."""
        return hashlib.sha256(json.dumps(self.numbers(), sort_keys=True).encode()).hexdigest()


def calibration_path(name: str | Path) -> Path:
    """The path of a calibration.

    Args:
        name: a path (anything with a slash or ending in `.json`), or a name, which stands for `NAME.json` in
            `$XDG_CONFIG_HOME/ibrobot/calibration` (`~/.config/ibrobot/calibration`).
    """
    if isinstance(name, Path) or "/" in name or name.endswith(".json"):
        return Path(name).expanduser()
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return home / "ibrobot" / "calibration" / f"{name}.json"


def companion_path(path: Path) -> Path:
    """The path of the companion file, which holds arm, date, adapter, position of 0 rad and hash."""
    return path.with_suffix(".meta.json")


def load_calibration(
    name: str | Path, joints: Sequence[str] | None = None, *, zero_at: str | None = None, tool: str | None = None,
    device: str = "",
) -> Calibration:  # fmt: skip
    """Load a calibration: LeRobot's JSON (motor -> numbers) or IB-Robot's (servo id -> numbers).

    The companion file gives the position of 0 rad. A file without one comes from another program: in LeRobot 0 is the
    middle of the range, in IB-Robot the pose set by hand.

    Args:
        name: a name or a path, see `calibration_path`.
        joints: names of the required joints; for IB-Robot's file, in the order of their ids from 1, unless they are
            its numbers. None: the names in the file.
        zero_at: position of 0 rad, one of `ZERO_AT`; overrides the companion file, whose hash is then not checked.
        tool: the command that has `calibrate` and `import` for this hardware, for error messages, e.g.
            `ibrobot my_arm`.
        device: what that command takes to reach the hardware, e.g. a port; empty: nothing.

    Raises:
        CalibrationError: if it is missing or invalid; names file, joint, key, value and the valid values.
    """
    path = calibration_path(name)
    text, document = _document(path, tool, device)
    if not isinstance(document, dict) or not document:
        raise CalibrationError(f"{path}: must be an object of joints, each with {_KEYS}")
    numbered = all(_NUMBER.fullmatch(key) for key in document)
    if numbered:
        document = _by_name(document, path, joints)
    joints_read = {}
    for joint, numbers in document.items():
        try:
            joints_read[joint] = _joint(numbers)
        except ValueError as error:
            servo = numbers.get("id") if isinstance(numbers, dict) else None
            line = _line(text, joint if f'"{joint}"' in text else str(servo), str(error).partition(":")[0])
            raise CalibrationError(f"{path}:{line}: {joint}: {error}") from None
    if joints is not None and (missing := [joint for joint in joints if joint not in joints_read]):
        raise CalibrationError(f"{path}: has no joint {missing[0]!r}; it has: {', '.join(joints_read)}")
    try:
        calibration = Calibration(joints_read, path=path)
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
    calibration = calibration.with_zero_at("pose" if numbered else "range")
    loaded = _with_meta(calibration, path, tool, any_numbers=zero_at is not None)
    return loaded if zero_at is None else loaded.with_zero_at(zero_at)


def _document(path: Path, tool: str | None = None, device: str = "") -> tuple[str, Any]:
    try:
        text = path.read_text()
        return text, json.loads(text, object_pairs_hook=_once)
    except FileNotFoundError:
        files = calibration_path("any").parent.glob("*.json")
        names = sorted(file.stem for file in files if not file.stem.endswith(".meta"))
        calibrate = "calibrate with the command of the hardware's plugin"
        remedy = f"{f'name one of yours: {", ".join(names)}' if names else calibrate}; or give the path of a file"
        if tool:
            name = path.stem if path == calibration_path(path.stem) else path
            remedy = f"`{tool} calibrate --name {name}` makes one"
            if device:
                remedy = f"`{tool} calibrate {device} --name {name}` makes one"
        raise CalibrationError(f"{path}: there is no such calibration; {remedy}") from None
    except json.JSONDecodeError as error:
        raise CalibrationError(f"{path}:{error.lineno}: not JSON: {error.msg}") from None
    except (OSError, RecursionError, UnicodeDecodeError, ValueError) as error:
        raise CalibrationError(f"{path}: cannot be read: {error}") from None


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len({*names}) < len(names):
        raise ValueError(f"{max(names, key=names.count)!r} is there twice")
    return dict(pairs)


def _line(text: str, *keys: str) -> int:
    """The line of the innermost of the nested keys that exists."""
    position = 0
    for key in keys:
        match = re.compile(re.escape(json.dumps(key)) + r"\s*:").search(text, position)
        position = match.start() if match else position
    return text.count("\n", 0, position) + 1


def _joint(numbers: Any) -> JointCalibration:
    if not isinstance(numbers, dict):
        raise ValueError(f"must be an object with {_KEYS}, not {numbers!r}")
    if unknown := [key for key in numbers if key not in _NUMBERS]:
        raise ValueError(f"{unknown[0]}: unknown key; known: {_KEYS}")
    if missing := [key for key in _NUMBERS if key not in numbers]:
        raise ValueError(f"{missing[0]}: is missing")
    return JointCalibration(**numbers)


def _by_name(document: dict[str, Any], path: Path, joints: Sequence[str] | None) -> dict[str, Any]:
    """Convert IB-Robot's format to LeRobot's: servo ids become names that are no numbers, and `id` has them."""
    own, named = joints is None or document.keys() >= set(joints), dict[str, Any]()
    names = {int(key): key for key in document} if own else dict(enumerate(joints or (), 1))
    for key, numbers in document.items():
        if (servo := int(key)) not in names:
            raise CalibrationError(f"{path}: {key}: no such servo; ids are 1 to {len(names)}")
        if not isinstance(numbers, dict) or (numbers.get("id", servo) != servo and not own):
            raise CalibrationError(f"{path}: {key}: must be an object with {_KEYS}; its id must be {servo}")
        named[names[servo]] = {"id": servo, "drive_mode": 0, **numbers}
    return named


def _with_meta(calibration: Calibration, path: Path, tool: str | None, *, any_numbers: bool) -> Calibration:
    companion = companion_path(path)
    if not companion.exists():
        return calibration
    _, meta = _document(companion)
    if not isinstance(meta, dict) or meta.get("version") != VERSION:
        stated = meta.get("version") if isinstance(meta, dict) else meta
        raise CalibrationError(f"{companion}: version: must be {VERSION}, not {stated!r}")
    zero_at = str(meta.get("zero_at"))
    if zero_at not in ZERO_AT:
        raise CalibrationError(f"{companion}: zero_at: must be one of {', '.join(ZERO_AT)}, not {zero_at!r}")
    if meta.get("sha256") != calibration.fingerprint() and not any_numbers:
        changed = datetime.fromtimestamp(path.stat().st_mtime, UTC).isoformat(timespec="seconds")
        command = f"`{tool} import {path} --zero-at {zero_at} --yes`"
        raise CalibrationError(
            f"{path}: the numbers, changed {changed}, are not those calibrated {meta.get('date')} that "
            f"{companion.name} tells of: calibrate again, or if they are right, take them with "
            f"{command if tool else 'the import command of the hardware plugin'}"
        )
    robot, date, adapter = (str(meta.get(name, "")) for name in ("robot", "date", "adapter"))
    return attrs.evolve(calibration.with_zero_at(zero_at), robot=robot, date=date, adapter=adapter)
