"""The file of `simulation.parameters`: how the servos and joints of a simulated arm behave, and how well it is known.

`ibrobot identify` writes it, and the simulation reads it. Importing this module imports no MuJoCo.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import Robot, did_you_mean, documented, option
from ibrobot_core.app import ConfigError, Problem, dump_yaml, parse_yaml, single_options

SCHEMA = 1
_MOST_BYTES = 256 * 1024


def _finite(instance: object, attribute: attrs.Attribute[Any], value: float | None) -> None:
    if value is not None and not math.isfinite(value):
        raise ValueError(f"{value} is not finite")


@documented
@attrs.frozen
class JointParameters:
    """The servo of a joint, and its friction. The servo's own damping is part of `damping`."""

    kp: float = option(unit="Nm/rad", gt=0, le=1e5, help="torque for each radian between command and joint")
    damping: float = option(
        unit="Nm s/rad", ge=0, le=1e4, help="torque against the speed: of the motor's back-EMF, and viscous friction"
    )
    frictionloss: float = option(unit="Nm", ge=0, le=1e3, help="dry friction")
    armature: float = option(unit="kg m^2", ge=0, le=1e3, help="rotor inertia seen by the joint")
    torque_limit: float | None = option(
        None, unit="Nm", gt=0, le=1e5, help="largest torque of the servo; None: that of the MJCF"
    )
    backlash: float = option(0.0, unit="rad", ge=0, le=1, help="lost motion when the command reverses")
    bias: float = option(
        0.0, unit="rad", ge=-1, le=1, validator=_finite, help="how far from its command the servo rests without load"
    )


@documented
@attrs.frozen
class Identification:
    """Where the parameters come from, and how well they are known."""

    episodes: tuple[str, ...] = option((), help="the recordings")
    seconds: float = option(0.0, unit="s", ge=0, help="duration of the recordings")
    made: str = option("", help="date, as ISO 8601")
    held_out_rms: Mapping[str, float] = option(
        factory=dict, help="rms error on recordings that the fit has not seen [rad], of each model"
    )
    deviations: Mapping[str, Mapping[str, float]] = option(
        factory=dict, help="joint, or arm -> parameter -> its standard deviation, in the unit of the parameter"
    )
    unknown: tuple[str, ...] = option((), help="what the recordings could not tell, e.g. gripper.torque_limit")


@documented
@attrs.frozen(kw_only=True)
class ArmParameters:
    """The parameters of an arm."""

    schema: int = option(choices=(SCHEMA,), help="version of this format")
    robot: str = option("", help="name of the robot")
    delay: float = option(0.0, unit="s", ge=0, le=1, help="time from a command to the servo")
    gravity_compensation: float | None = option(
        None, ge=-1, le=2, help="share of the arm's weight that something else carries; None: as the MJCF says"
    )
    joints: Mapping[str, JointParameters] = option(help="joint -> its parameters")
    identified: Identification = option(factory=Identification, help="where they come from")

    def __attrs_post_init__(self) -> None:
        if not self.joints:
            raise ValueError("joints is empty; give each joint of the robot its parameters")

    def faults(self, robot: Robot) -> Iterator[tuple[tuple[str, ...], str]]:
        """Key and message of each reason why they do not fit a robot."""
        known = robot.joint_names
        for joint in self.joints:
            if joint not in known:
                yield ("joints", joint), f"the robot has no such joint{did_you_mean(joint, known, 'known')}"
        missing = [joint for joint in known if joint not in self.joints]
        if missing:
            yield ("joints",), f"{', '.join(missing)}: missing; a file has each joint of the robot"


def read_parameters(path: Path, robot: Robot | None = None) -> ArmParameters:
    """Read a file.

    Args:
        path: the file.
        robot: the robot that it must fit; None to accept any joints.

    Raises:
        ConfigError: with all faults, each with file, line and key.
    """
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_MOST_BYTES + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise ConfigError([Problem(str(path), 0, "", f"cannot be read: {reason}")]) from None
    parameters = single_options(ArmParameters, (), str(path), text=text, expands=False)
    if robot is not None and (faults := list(parameters.faults(robot))):
        document = parse_yaml(text, str(path), expands=False)
        for key, message in faults:
            document.add(key, message)
        document.raise_problems()
    return parameters


def as_yaml(parameters: ArmParameters) -> str:
    """The parameters as the text of a file, with numbers of four digits."""
    joints = {joint: _numbers(attrs.asdict(each)) for joint, each in parameters.joints.items()}
    document = {
        "schema": parameters.schema, "robot": parameters.robot, "delay": _rounded(parameters.delay),
        "gravity_compensation": _rounded(parameters.gravity_compensation), "joints": joints,
    }  # fmt: skip
    known = attrs.asdict(parameters.identified)
    if known != attrs.asdict(Identification()):
        document["identified"] = _plain(known)
    return dump_yaml(document)


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def _numbers(values: Mapping[str, float | None]) -> dict[str, float | None]:
    return {name: _rounded(value) for name, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return _rounded(value) if isinstance(value, float) else value
