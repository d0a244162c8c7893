"""`ibrobot config new`: a robot YAML for an arm that is described by a URDF."""

from __future__ import annotations

from pathlib import Path

import click

from ibrobot_core.api import HardwareError
from ibrobot_core.app import echo, installed_plugins, load_config, wrong_input
from ibrobot_mujoco.mjcf_model import complete_model
from ibrobot_mujoco.urdf_model import RobotModel, make_model

_FILE = click.Path(path_type=Path, exists=True, dir_okay=False)


@click.command("new")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--urdf", type=_FILE, help="URDF or xacro file of the arm.")
@click.option("--mjcf", type=_FILE, help="Instead of a URDF: an MJCF of the arm, whose drives stay.")
@click.option("--lerobot", metavar="ROBOT", help="Instead of a URDF: a robot of LeRobot's, e.g. koch_follower.")
@click.option(
    "--tip", metavar="LINK", help="Link, body or site whose frame is the tool's.  [default: found by its name]"
)
@click.option(
    "--package",
    "packages",
    multiple=True,
    metavar="NAME=FOLDER",
    help="Folder of a ROS package that the URDF names.  [default: a folder of that name above the file]",
)
@click.pass_context
def new(
    context: click.Context, out: Path, urdf: Path | None, mjcf: Path | None, lerobot: str | None, tip: str | None,
    packages: tuple[str, ...],
) -> None:  # fmt: skip
    """Write a robot YAML for an arm in a URDF or an MJCF, or of LeRobot's.

    OUT is a new file, e.g. arm.yaml. Beside it, the folder arm_model holds an MJCF and the meshes. The YAML states
    every value that was guessed.
    """
    if sum(each is not None for each in (urdf, mjcf, lerobot)) != 1:
        raise click.UsageError("give one of --urdf, --mjcf and --lerobot")
    if lerobot is not None:
        context.invoke(_command_of_lerobot(), out=out, robot=lerobot, id_=None)
        return
    source = urdf or mjcf
    assert source is not None
    folders = {}
    for each in packages:
        name, equals, place = each.partition("=")
        if not equals or not Path(place).is_dir():
            raise click.BadParameter(
                f"expected NAME=FOLDER of an existing folder, got {each!r}", param_hint="--package"
            )
        folders[name] = Path(place)
    folder = out.with_name(f"{out.stem}_model")
    try:
        source.read_bytes()
    except OSError as error:
        raise click.FileError(str(source), hint=error.strerror) from error
    with wrong_input():
        for path in (out, folder):
            if path.exists():
                raise HardwareError(f"{path} exists already, and is not overwritten")
        model = make_model(urdf, folder, folders, tip) if urdf else complete_model(source, folder, tip)
    out.write_text(robot_yaml(model, source, folder.name), encoding="utf-8")
    load_config(out, sim=True)
    arm = [joint.name for joint in model.joints if not joint.gripper]
    echo(f"{out}: {model.name}, {len(arm)} joints{' and a gripper' if len(arm) < len(model.joints) else ''}")
    for note in model.notes:
        echo(f"note: {note}")
    echo(f"try it: ibrobot launch {out} --sim --mode web --web")


def _command_of_lerobot() -> click.Command:
    """`ibrobot lerobot new`, of another plugin."""
    group = installed_plugins().command("lerobot").load()
    assert isinstance(group, click.Group)
    return group.commands["new"]


def robot_yaml(model: RobotModel, source: Path, folder: str) -> str:
    """The robot YAML of a model.

    Args:
        model: the model.
        source: the file that it was made from.
        folder: name of the folder with the model, beside the YAML.
    """
    arm = [joint.name for joint in model.joints if not joint.gripper]
    gripper = [joint.name for joint in model.joints if joint.gripper]
    groups = f"{{arm: [{', '.join(arm)}]" + (f", gripper: [{', '.join(gripper)}]" if gripper else "") + "}"
    joints = "\n".join(
        f"    - {{name: {joint.name}, lower: {joint.lower:.6g}, upper: {joint.upper:.6g}, "
        f"max_velocity: {joint.max_velocity:.6g}, max_acceleration: {joint.max_acceleration:.6g}}}"
        for joint in model.joints
    )
    notes = "\n".join(f"# - {note}" for note in model.notes)
    stream = "arm_position, gripper_position" if gripper else "arm_position"
    plan = "arm_trajectory, gripper_action" if len(gripper) == 1 else "arm_trajectory"
    executors = [
        "arm_position: {type: position, group: arm}",
        "arm_trajectory: {type: trajectory, group: arm, goal_tolerance: 0.005}",  # the guessed drives come closer
    ]
    if gripper:
        executors.append("gripper_position: {type: position, group: gripper}")
    if len(gripper) == 1:
        executors.append("gripper_action: {type: gripper, group: gripper}")
    lines = "\n".join(f"  {each}" for each in executors)
    return f"""\
# {model.name}, made by `ibrobot config new` from {source.name}. Units are SI: radians, metres, seconds.
# What that file does not say is a guess:
{notes}
# A real arm needs a section `hardware` with a plugin for it.
robot:
  name: {model.name}
  joints:                                 # order here = order in every vector
{joints}
  groups: {groups}
  description:
    mjcf: {folder}/model.xml
    tip: {model.tip}
    poses:
      home: [{", ".join(f"{value:g}" for value in model.home)}]

simulation:
  type: mujoco
  scene: empty
  start_pose: home

executors:
{lines}

control_modes:
  hold:                                   # holds its pose, and needs no other plugin
    executors: [{stream}]
  web:                                    # in the browser, with `ibrobot launch --web`
    executors: [{stream}]
    teleop: web
  jog:                                    # by keys of the terminal
    executors: [{stream}]
    teleop: keyboard
  moveit_planning:
    executors: [{plan}]
    planner: {{type: rrt_connect}}
default_control_mode: hold

teleoperation:
  web: {{type: web}}
  keyboard: {{type: keyboard}}

control: {{rate_hz: 100, stop: hold}}
"""
