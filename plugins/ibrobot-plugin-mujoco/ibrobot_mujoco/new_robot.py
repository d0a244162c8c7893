"""`ibrobot config new`: a robot YAML for an arm that is described by a URDF."""

from __future__ import annotations

import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import attrs

from ibrobot_core.api import HardwareError, option
from ibrobot_core.app import ConfigError, RequestError, dump_yaml, echo, installed_plugins, load_config, wrong_input
from ibrobot_mujoco.chains import Chain
from ibrobot_mujoco.mjcf_model import complete_model
from ibrobot_mujoco.urdf_model import DrivenJoint, RobotModel, make_model

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_SHARE = 0.1
"""Share of the model's velocities and accelerations that a new robot YAML allows."""
_LOW = "max_velocity and max_acceleration are LOW, a tenth of the model's, and max_acceleration is a guess"


@attrs.frozen(kw_only=True)
class NewRobot:
    """Write a robot YAML for an arm in a URDF or an MJCF, or of LeRobot's.

    OUT is a new file, e.g. arm.yaml. Beside it, the folder arm_model holds an MJCF and the meshes. The YAML states
    every value that was guessed. Several arms in one file get a joint group each.
    """

    out: Path = option(typed="OUT", help="the new file")
    urdf: Path | None = option(None, help="URDF or xacro file of the arm")
    mjcf: Path | None = option(None, help="instead of a URDF: an MJCF of the arm, whose drives stay")
    lerobot: str | None = option(
        None, typed="--lerobot ROBOT", help="instead of a URDF: a robot of LeRobot's, e.g. koch_follower"
    )
    units: tuple[str, ...] = option(
        (),
        typed="--unit [NAME=]UNIT",
        help="with --lerobot: unit of the joint or axis NAME, or of all joints, where LeRobot does not say it",
    )
    tip: str | None = option(
        None, typed="--tip LINK", help="link, body or site whose frame is the tool's; by default found by its name"
    )
    packages: tuple[str, ...] = option(
        (),
        typed="--package NAME=FOLDER",
        help="folder of a ROS package that the file names; by default a folder of that name above or beside the file",
    )
    arguments: tuple[str, ...] = option((), typed="--xacro-arg NAME=VALUE", help="value of an argument of a xacro file")

    def __call__(self) -> None:
        if sum(each is not None for each in (self.urdf, self.mjcf, self.lerobot)) != 1:
            raise RequestError("give one of --urdf, --mjcf and --lerobot")
        if self.units and self.lerobot is None:
            raise RequestError("--unit is of --lerobot")
        if self.lerobot is not None:
            of_lerobot = installed_plugins().command("lerobot new").options
            of_lerobot(out=self.out, robot=self.lerobot, units=self.units)()
            return
        source = self.urdf or self.mjcf
        assert source is not None
        folders = {}
        for each in self.packages:
            name, equals, place = each.partition("=")
            if not equals or not name or not Path(place).is_dir():
                raise RequestError(f"--package: expected NAME=FOLDER of an existing folder, got {each!r}")
            folders[name] = Path(place).absolute()
        values = {}
        for each in self.arguments:
            name, equals, value = each.partition(":=" if ":=" in each else "=")
            if not equals or not name:
                raise RequestError(f"--xacro-arg: expected NAME=VALUE, got {each!r}")
            values[name] = value
        try:
            source.read_bytes()
        except OSError as error:
            raise RequestError(f"{source}: cannot be read: {error.strerror}") from error
        with wrong_input(), _prepared(self.out) as (draft, folder):
            model = (
                make_model(self.urdf, folder, folders, self.tip, values)
                if self.urdf
                else complete_model(source, folder, self.tip)
            )
            draft.write_text(robot_yaml(model, source, folder.name), encoding="utf-8")
            try:
                load_config(draft, sim=True)
            except ConfigError as error:
                raise ConfigError(attrs.evolve(each, file=str(self.out)) for each in error.problems) from None
        echo(f"{self.out}: {model.name}, {_summary(model.chains)}")
        for note in model.notes:
            echo(f"note: {note}")
        for doubt in model.doubts:
            echo(f"check: {doubt}")
        echo(f"try it: `ibrobot launch {self.out} --sim --mode web --web`")
        echo(f"{_LOW}. Before you raise them for a real arm, read its datasheet.")


@contextmanager
def _prepared(out: Path) -> Iterator[tuple[Path, Path]]:
    """A place for the new file and its folder, which move to theirs at the end; nothing is left after an error."""
    folder = out.with_name(f"{out.stem}_model")
    for path in (out, folder):
        if path.exists():
            raise HardwareError(f"{path} exists already, and is not overwritten")
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.stem}.", dir=out.absolute().parent) as name:
            place = Path(name)
            yield place / out.name, place / folder.name
            (place / folder.name).rename(folder)
            try:
                (place / out.name).rename(out)
            except BaseException:
                shutil.rmtree(folder)
                raise
    except OSError as error:
        raise HardwareError(f"{out} cannot be written: {error.strerror or error}") from error


def _summary(chains: Sequence[Chain]) -> str:
    """How many joints each chain has."""
    texts = [_plural(len(each.joints)) + (" and a gripper" if each.gripper else "") for each in chains]
    if len(chains) == 1:
        return texts[0]
    return ", ".join(f"{chain.name} with {text}" for chain, text in zip(chains, texts, strict=True))


def _plural(count: int) -> str:
    return f"{count} joint{'s' if count != 1 else ''}"


def _word(text: str) -> str:
    """A text within a line of YAML."""
    plain = _PLAIN.fullmatch(text) and dump_yaml([text]) == f"- {text}\n"
    return text if plain else json.dumps(text, ensure_ascii=False)


def _list(names: Sequence[str]) -> str:
    return f"[{', '.join(map(_word, names))}]"


def _limits(lower: float, upper: float) -> tuple[str, str]:
    """Limits with few digits, and within the given ones."""
    return f"{math.ceil(lower * 1e6) / 1e6:.10g}", f"{math.floor(upper * 1e6) / 1e6:.10g}"


def _joint(joint: DrivenJoint, *, grips: bool) -> str:
    """A joint; `grips` marks a gripper's joint whose group is not named gripper."""
    lower, upper = _limits(joint.lower, joint.upper)
    velocity, acceleration = _SHARE * joint.max_velocity, _SHARE * joint.max_acceleration
    return (
        f"{{name: {_word(joint.name)}, lower: {lower}, upper: {upper}, max_velocity: {velocity:.6g}, "
        f"max_acceleration: {acceleration:.6g}{', grips: true' if grips and joint.gripper else ''}}}"
    )


@attrs.frozen
class _Parts:
    """The parts of the YAML that depend on the chains."""

    groups: dict[str, tuple[str, ...]]
    executors: dict[str, str]
    modes: dict[str, str]
    devices: dict[str, str]


def _one_arm(chain: Chain) -> _Parts:
    gripper = chain.gripper
    stream = "arm_position, gripper_position" if gripper else "arm_position"
    plan = "arm_trajectory, gripper_action" if len(gripper) == 1 else "arm_trajectory"
    executors = {
        "arm_position": "{type: position, group: arm}",
        "arm_trajectory": "{type: trajectory, group: arm, goal_tolerance: 0.005}",  # guessed drives come closer
    }
    if gripper:
        executors["gripper_position"] = "{type: position, group: gripper}"
    if len(gripper) == 1:
        executors["gripper_action"] = "{type: gripper, group: gripper}"
    modes = {
        "hold:                                   # holds its pose, and needs no other plugin": f"executors: [{stream}]",
        "web:                                    # in the browser, with `ibrobot launch --web`": (
            f"executors: [{stream}]\n    teleop: web"
        ),
        "jog:                                    # by keys of the terminal": (
            f"executors: [{stream}]\n    teleop: keyboard"
        ),
        "moveit_planning:": f"executors: [{plan}]\n    planner: {{type: rrt_connect}}",
    }
    groups = {"arm": chain.joints, **({"gripper": gripper} if gripper else {})}
    return _Parts(groups, executors, modes, {"web": "{type: web}", "keyboard": "{type: keyboard}"})


def _several(chains: Sequence[Chain]) -> _Parts:
    """A group, a device and a mode for each chain; those of the other chains hold their pose."""
    parts = _Parts({}, {}, {}, {})
    streams = ", ".join(f"{each.name}_position" for each in chains)
    teleop = ", ".join(f"{each.name}: web_{each.name}" for each in chains)
    parts.modes["hold:                                   # holds its pose, and needs no other plugin"] = (
        f"executors: [{streams}]"
    )
    parts.modes["web:                                    # in the browser, with `ibrobot launch --web`"] = (
        f"executors: [{streams}]\n    teleop: {{{teleop}}}"
    )
    for number, chain in enumerate(chains):
        name, arm = chain.name, f"{chain.name}_arm" if chain.gripper else chain.name
        parts.groups[name] = (*chain.joints, *chain.gripper)
        parts.executors[f"{name}_position"] = f"{{type: position, group: {name}}}"
        parts.executors[f"{name}_trajectory"] = f"{{type: trajectory, group: {arm}, goal_tolerance: 0.005}}"
        options = ""
        if chain.gripper:
            parts.groups.update({arm: chain.joints, chain.gripper_group: chain.gripper})
            options = f", gripper: {chain.gripper_group}"
        parts.devices[f"web_{name}"] = f"{{type: web{options}}}"
        options += ", cartesian: false" if number else ""  # the tool is that of the first chain
        parts.devices[f"keyboard_{name}"] = f"{{type: keyboard{options}}}"
        parts.modes[f"jog_{name}:"] = f"executors: [{streams}]\n    teleop: {{{name}: keyboard_{name}}}"
        planned = f"{name}_trajectory"
        if len(chain.gripper) == 1:
            parts.executors[f"{name}_gripper_action"] = f"{{type: gripper, group: {chain.gripper_group}}}"
            planned += f", {name}_gripper_action"
        parts.modes[f"plan_{name}:"] = f"executors: [{planned}]\n    planner: {{type: rrt_connect}}"
    return parts


def robot_yaml(model: RobotModel, source: Path, folder: str) -> str:
    """The robot YAML of a model.

    Args:
        model: the model.
        source: the file that it was made from.
        folder: name of the folder with the model, beside the YAML.
    """
    parts = _one_arm(model.chains[0]) if len(model.chains) == 1 else _several(model.chains)
    joints = "\n".join(f"    - {_joint(each, grips=len(model.chains) > 1)}" for each in model.joints)
    groups = "\n".join(f"    {name}: {_list(names)}" for name, names in parts.groups.items())
    executors = "\n".join(f"  {name}: {text}" for name, text in parts.executors.items())
    modes = "\n".join(f"  {name}\n    {text}" for name, text in parts.modes.items())
    devices = "\n".join(f"  {name}: {text}" for name, text in parts.devices.items())
    notes = "\n".join([f"# - {note}" for note in model.notes] + [f"# - CHECK: {doubt}" for doubt in model.doubts])
    return f"""\
# {model.name}, made by `ibrobot config new` from {_word(source.name)}. Units are SI: radians, metres, seconds.
# What that file does not say is a guess:
{notes}
# A real arm needs a section `hardware` with a plugin for it.
# {_LOW}.
# Before you raise them for a real arm, read its datasheet.
robot:
  name: {_word(model.name)}
  joints:                                 # order here = order in every vector
{joints}
  groups:
{groups}
  description:
    mjcf: {_word(f"{folder}/model.xml")}
    tip: {_word(model.tip)}
    poses:
      home: [{", ".join(f"{value:.10g}" for value in model.home)}]

simulation:
  type: mujoco
  scene: empty
  start_pose: home

executors:
{executors}

control_modes:
{modes}
default_control_mode: hold

teleoperation:
{devices}

control: {{rate_hz: 100, stop: hold}}
"""
