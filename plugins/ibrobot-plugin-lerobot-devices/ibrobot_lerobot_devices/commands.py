"""`ibrobot lerobot …`: lists LeRobot's devices, and switches the torque of one off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ibrobot_core.api import HardwareError, did_you_mean
from ibrobot_core.app import Declined, echo, wrong_input
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem
from ibrobot_lerobot_devices.registry import registry
from ibrobot_lerobot_devices.units import OTHERS, UNITS

_KINDS = {"robot": "robots: hardware", "teleoperator": "teleoperators: teleop", "camera": "cameras: peripherals"}
_START_S = 60.0


@click.group()
def lerobot() -> None:
    """List LeRobot's devices, which hardware, teleop and cameras of type lerobot use."""


@lerobot.command("list")
@click.argument("type_", metavar="[TYPE]", required=False)
def list_devices(type_: str | None) -> None:
    """List devices of LeRobot, or the config of TYPE.

    Those of installed third-party packages are among them.
    """
    devices = _registry()
    if type_ is None:
        echo(f"LeRobot {devices['version']}")
        for kind, title in _KINDS.items():
            echo(f"{title} of type lerobot: {', '.join(devices[kind]) or 'none'}")
        return
    known = {kind: devices[kind][type_] for kind in _KINDS if type_ in devices[kind]}
    if not known:
        names = [name for kind in _KINDS for name in devices[kind]]
        raise click.BadParameter(f"LeRobot has no {type_!r}{did_you_mean(type_, names, 'it has')}", param_hint="TYPE")
    for kind, each in known.items():
        echo(f"{kind} {type_}: {each['module']}.{each['class']}")
        _show(each["fields"], "  ")


def _show(fields: Mapping[str, Any], indent: str) -> None:
    for name, field in fields.items():
        default = "required" if field["required"] else f"default {field.get('default')}"
        echo(f"{indent}{name}: {' or '.join(field['type'])}; {default}")
        _show(field.get("fields", {}), f"{indent}  ")


@lerobot.command("new")
@click.argument("out", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("robot")
@click.option("--id", "id_", metavar="ID", help="LeRobot's id of it, the name of its calibration.  [default: ROBOT]")
@click.option(
    "--unit",
    "units",
    multiple=True,
    metavar="[NAME=]UNIT",
    help=f"Unit of the joint or axis NAME, or of all joints, where LeRobot does not say it: {', '.join(UNITS)}.",
)
def new(out: Path, robot: str, id_: str | None, units: tuple[str, ...]) -> None:
    """Write a robot YAML for ROBOT, e.g. koch_follower, to OUT."""
    from ibrobot_lerobot_devices.new_robot import write_robot

    given: dict[str, str] = {}
    for each in units:
        name, equals, unit = each.rpartition("=")
        if unit not in UNITS:
            raise click.BadParameter(f"{unit!r}{did_you_mean(unit, UNITS, 'it is one of')}", param_hint="--unit")
        given[name if equals else OTHERS] = unit
    with wrong_input():
        written = write_robot(out, robot, id_ or robot, given)
    echo(f"{out}: {written.type}, {len(written.mapped)} joints")
    if not written.measured:
        echo(f"note: limits of joints are guesses, since LeRobot has no calibration {id_ or robot}: check them")
    if written.unknown_leader:
        echo(f"note: the file has no leader: {written.unknown_leader}")
    echo(f"try it: ibrobot launch {out}")


@lerobot.command("torque-off")
@click.argument("robot")
@click.option(
    "--config", required=True, metavar="JSON", help='LeRobot\'s config of it, e.g. \'{"port": "/dev/ttyACM0"}\'.'
)
@click.option("--yes", is_flag=True, help="Switch off without asking.")
def torque_off(robot: str, config: str, yes: bool) -> None:
    """Switch the torque of ROBOT off, e.g. koch_follower."""
    try:
        values = json.loads(config)
    except ValueError as error:
        raise click.BadParameter(f"is not JSON: {error}", param_hint="--config") from None
    echo("Without torque the arm falls: hold it, or check that it rests on something.")
    if not (yes or click.confirm("Torque off?", err=True)):
        raise Declined
    link = DeviceLink("robot", robot, values)
    try:
        if not link.start(_START_S)["torque"]:
            raise HardwareError(f"LeRobot's {robot} has no call that switches the torque off")
        link.call("relax", _START_S)
    except DeviceProblem as problem:
        raise HardwareError(f"{robot}: {problem}") from None
    finally:
        link.end()
    echo(f"torque off: {robot}")


def _registry() -> Mapping[str, Any]:
    try:
        return registry()
    except DeviceProblem as problem:
        raise HardwareError(str(problem)) from None
