"""`ibrobot lerobot new`, and `ibrobot config new --lerobot`: a robot YAML for a robot of LeRobot's."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

import attrs

from ibrobot_core.api import HardwareError, did_you_mean
from ibrobot_core.app import ConfigError, dump_yaml, load_config, parse_yaml
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem
from ibrobot_lerobot_devices.registry import registry
from ibrobot_lerobot_devices.stand_in import NEEDS_TORCH
from ibrobot_lerobot_devices.units import (
    AXES,
    DEGREES,
    METRES,
    OTHERS,
    PERCENT,
    POSITION,
    SYMMETRIC,
    UNITS,
    Choices,
    Mapped,
    bases,
    driven,
    map_joints,
    unit_of,
)

_START_S = 60.0
_GUESS = math.pi / 2
"""Limit of a joint whose range LeRobot does not say [rad]."""
_PORT = "/dev/ttyACM0"
_WAY = 1000.0
"""Limit of the way of a base, which has none [m, rad]."""
_SPEEDS = "max_velocity: 0.3, max_acceleration: 2.0", "max_velocity: 1.5, max_acceleration: 10.0"
"""Guesses for an axis along which a base drives [m/s, m/s^2], and about which it turns [rad/s, rad/s^2]."""


@attrs.frozen
class NewRobot:
    """A robot of LeRobot's, as its robot YAML needs it."""

    type: str
    config: Mapping[str, Any]
    mapped: list[Mapped]
    units: Mapping[str, str]
    limits: Mapping[str, tuple[float, float]]
    measured: bool
    """Whether the limits are those of its calibration."""
    leader: str
    """A teleoperator with the same joints; empty if LeRobot has none of that name, or does not say its units."""
    unknown_leader: str
    """Why there is no leader although LeRobot has one of that name; else empty."""
    torch: bool
    """Whether it needs torch."""
    axes: tuple[str, ...]
    """The axes of its base."""


def describe_robot(type_: str, id_: str, units: Mapping[str, str]) -> NewRobot:
    """What LeRobot says about a robot without its device.

    Args:
        type_: LeRobot's type.
        id_: LeRobot's id of the robot, which is the name of its calibration.
        units: the units that LeRobot does not say, as the option `units` of the hardware.

    Raises:
        HardwareError: if it has no joints, cannot be made, or a unit is not known.
    """
    try:
        devices = registry()
        if type_ not in devices["robot"]:
            raise HardwareError(
                f"LeRobot has no robot {type_!r}{did_you_mean(type_, list(devices['robot']), 'it has')}"
            )
        config = {**_required(devices["robot"][type_]["fields"], ""), "id": id_}
        torch = False
        try:
            facts = _facts("robot", type_, config, torch=torch)
        except DeviceProblem as problem:
            if NEEDS_TORCH not in str(problem):
                raise
            torch = True
            facts = _facts("robot", type_, config, torch=torch)
    except DeviceProblem as problem:
        raise HardwareError(f"{type_}: {problem}") from None
    joints = list(bases(facts["action_features"], POSITION))
    if not joints:
        raise HardwareError(f"LeRobot's {type_} has no joints: {', '.join(facts['action_features'])}")
    wheels = driven(facts["action_features"])
    axes = tuple(name for name in wheels if name in AXES and wheels[name] in facts["observation_features"])
    if unknown := _unknown(facts, units, axes):
        others = ", or --unit UNIT for all joints" if set(unknown) & set(joints) else ""
        raise HardwareError(
            f"LeRobot does not say the unit of {type_}'s {', '.join(unknown)}: look it up, and give it, e.g. "
            f"--unit {unknown[0]}=UNIT{others}; units are {', '.join(UNITS)}"
        )
    strange = sorted(set(units) - {*joints, *axes, OTHERS})
    if strange:
        raise HardwareError(f"{type_} has no {strange[0]!r}{did_you_mean(strange[0], [*joints, *axes], 'it has')}")
    mapped = _map(facts, joints, units)
    measured = all("range_min" in facts["motors"].get(name, {}) for name in joints)
    limits = {each.joint: _limits(each, facts["motors"].get(each.feature, {})) for each in mapped}
    leader = type_.replace("follower", "leader")
    known, why = "", ""
    if leader in devices["teleoperator"]:
        why = _why_not_led(leader, {**_required(devices["teleoperator"][leader]["fields"], ""), "id": leader}, torch)
        known = "" if why else leader
    return NewRobot(type_, config, mapped, units, limits, measured, known, why, torch, axes)


def _unknown(facts: Mapping[str, Any], units: Mapping[str, str], axes: Collection[str]) -> list[str]:
    """The joints, and those of the axes, whose unit neither LeRobot nor `units` says."""
    features = {**bases(facts["action_features"], POSITION), **driven(facts["action_features"])}
    wanted = {base: name for base, name in features.items() if base in axes or name.endswith(POSITION)}
    return [base for base, name in wanted.items() if not unit_of(name, facts["motors"], units)]


def _why_not_led(leader: str, config: Mapping[str, Any], torch: bool) -> str:
    """Why a leader cannot be in the file; empty if it can."""
    try:
        unknown = _unknown(_facts("teleoperator", leader, config, torch=torch), {}, ())
    except DeviceProblem as problem:
        return f"{leader}: {problem}"
    lack = f"LeRobot does not say the unit of {leader}'s {', '.join(unknown)}; add it with its option units"
    return lack if unknown else ""


def _facts(kind: str, type_: str, config: Mapping[str, Any], *, torch: bool) -> Mapping[str, Any]:
    """What LeRobot's object says about itself, with the variables of the environment as a run reads them."""
    expanded = parse_yaml(json.dumps(config), f"the config of {type_}")
    expanded.raise_problems()
    link = DeviceLink(kind, type_, expanded.root, torch=torch, only_make=True)
    try:
        return link.start(_START_S)
    finally:
        link.end()


def _required(fields: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    plain: Mapping[str, Any] = {"str": "", "int": 0, "float": 0.0, "bool": False}
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if "fields" in field:
            values[name] = _required(field["fields"], f"{prefix}{name.split('_')[0].upper()}_")
        elif field["required"]:
            variable = f"IBROBOT_{prefix}FOLLOWER_PORT"
            values[name] = f"${{{variable}:{_PORT}}}" if name == "port" else plain.get(field["type"][0], {})
    return {name: value for name, value in values.items() if value != {}}


def _map(facts: Mapping[str, Any], joints: list[str], units: Mapping[str, str]) -> list[Mapped]:
    limits = {name: (0.0 if "gripper" in name else -_GUESS, _GUESS) for name in joints}
    anchored = [name for name in joints if "gripper" in name]
    return map_joints(
        facts["action_features"], facts["motors"], Choices({}, units, "pose", anchored, ()), joints, limits
    )


def _limits(mapped: Mapped, motor: Mapping[str, Any]) -> tuple[float, float]:
    """The ends of the calibrated range [rad], or a guess."""
    if "range_min" not in motor or mapped.unit not in (DEGREES, PERCENT, SYMMETRIC):
        return (0.0 if "gripper" in mapped.joint else -_GUESS, _GUESS)
    match mapped.unit:
        case "degrees":
            half = (motor["range_max"] - motor["range_min"]) / 2 * 360 / (motor["resolution"] - 1)
            ends = (-half, half)
        case "range_0_100":
            ends = (0.0, 100.0)
        case _:
            ends = (-100.0, 100.0)
    first, last = sorted(mapped.scale.factor * end + mapped.scale.offset for end in ends)
    return (first, last)


def _word(name: str) -> str:
    """A name within a line of YAML."""
    plain = re.fullmatch("[A-Za-z_][A-Za-z0-9_.-]*", name) and dump_yaml([name]) == f"- {name}\n"
    return name if plain else json.dumps(name, ensure_ascii=False)


def _list(names: Iterable[str]) -> str:
    return f"[{', '.join(map(_word, names))}]"


def robot_yaml(made: NewRobot) -> str:
    """The robot YAML of a robot of LeRobot's."""
    names = [each.joint for each in made.mapped]
    gripper = [name for name in names if "gripper" in name]
    arm = [name for name in names if name not in gripper] or names
    gripper = [name for name in gripper if name not in arm]
    members = {"arm": arm, "gripper": gripper, "base": made.axes}
    groups = ", ".join(f"{name}: {_list(each)}" for name, each in members.items() if each)
    joints = "\n".join(
        f"    - {{name: {_word(name)}, lower: {made.limits[name][0]:.4f}, upper: {made.limits[name][1]:.4f}, "
        "max_velocity: 1.5, max_acceleration: 15.0}"
        for name in names
    )
    joints += "".join(
        f"\n    - {{name: {name}, lower: {-_WAY}, upper: {_WAY}, {_SPEEDS[AXES[name] != METRES]}}}"
        for name in made.axes
    )
    streams = ["arm_position", *(["gripper_position"] if gripper else [])]
    moved = [*streams, *(["base_position"] if made.axes else [])]
    executors = "\n".join(f"  {name}: {{type: position, group: {name.split('_')[0]}}}" for name in moved)
    actions = "\n".join(
        f"    - {{key: action, executor: {name}, topic: /{name}_controller/commands, "
        "type: std_msgs/msg/Float64MultiArray}"
        for name in streams
    )
    limits = (
        "limits are the ends of the calibrated ranges" if made.measured else "limits are guesses: LeRobot says none"
    )
    extra = f", units: {json.dumps(dict(made.units))}" if made.units else ""
    extra += ", torch: true" if made.torch else ""
    extra += f", anchored: {_list(gripper)}" if gripper and gripper != ["gripper"] else ""
    scaled = f", scaled: {_list(gripper)}" if gripper and gripper != ["gripper"] else ""
    options = f"config: {_leader_config(made)}{scaled}"
    leader = f"{{type: lerobot, teleop: {_word(made.leader)}, {options}}}"
    devices = f"  leader: {leader}\n" if made.leader else ""
    mode = f"  teleop:\n    executors: [{', '.join(streams)}]\n    teleop: leader\n" if made.leader else ""
    if made.axes:
        devices += "  cmd_vel: {type: cmd_vel}\n"
        mode += "  drive:                                  # by twists on /cmd_vel; the arm holds\n"
        mode += f"    executors: [{', '.join(moved)}]\n    teleop: {{base: cmd_vel}}\n"
    devices = f"teleoperation:\n{devices}\n" if devices else ""
    return f"""\
# {made.type} of LeRobot, made by `ibrobot config new --lerobot {made.type}`. Units are SI: radians, seconds.
# Check all joints before the first motion: {limits}; max_velocity and
# max_acceleration are guesses, too. LeRobot reports no torque, temperature or voltage.
robot:
  name: {_word(made.type)}
  robot_type: {_word(made.type)}
  joints:                                 # order here = order in every vector
{joints}
  groups: {{{groups}}}

hardware: {{type: lerobot, robot: {_word(made.type)}, config: {json.dumps(dict(made.config))}{extra}}}

executors:
{executors}

control_modes:
  hold:                                   # holds its pose
    executors: [{", ".join(streams)}]
{mode}default_control_mode: hold

{devices}contract:
  rate_hz: 30
  observations:
    - {{key: observation.state, topic: /joint_states, select: {_list(f"position.{name}" for name in names)}}}
  actions:
{actions}

control: {{rate_hz: 100, stop: hold}}
"""


def _leader_config(made: NewRobot) -> str:
    text = json.dumps({**made.config, "id": made.leader})
    return text.replace("FOLLOWER_PORT", "LEADER_PORT").replace(_PORT, "/dev/ttyACM1").replace("follower", "leader")


def write_robot(out: Path, type_: str, id_: str, units: Mapping[str, str]) -> NewRobot:
    """Write the robot YAML, and check it before it has its name; see `describe_robot`.

    Raises:
        ConfigError: if the YAML has a fault.
        HardwareError: if the file exists already or cannot be written, LeRobot does not know the robot, or a unit is
            not known.
    """
    if out.exists():
        raise HardwareError(f"{out} exists already, and is not overwritten")
    made = describe_robot(type_, id_, units)
    draft = out.with_name(f".{out.stem}.{uuid4().hex}.yaml")
    try:
        draft.write_text(robot_yaml(made), encoding="utf-8")
        load_config(draft)
        draft.rename(out)
    except ConfigError as error:
        raise ConfigError(attrs.evolve(each, file=str(out)) for each in error.problems) from None
    except OSError as error:
        raise HardwareError(f"{out} cannot be written: {error.strerror}") from error
    finally:
        draft.unlink(missing_ok=True)
    return made
