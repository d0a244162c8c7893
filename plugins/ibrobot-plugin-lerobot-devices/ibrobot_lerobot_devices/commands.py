"""`ibrobot lerobot …`: lists LeRobot's devices, and switches the torque of one off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined, confirm

from ibrobot_core.api import HardwareError, did_you_mean, option
from ibrobot_core.app import RequestError, echo, wrong_input
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem
from ibrobot_lerobot_devices.registry import registry
from ibrobot_lerobot_devices.units import OTHERS, UNITS

_KINDS = {"robot": "robots: hardware", "teleoperator": "teleoperators: teleop", "camera": "cameras: peripherals"}
_START_S = 60.0


@attrs.frozen(kw_only=True)
class ListDevices:
    """List devices of LeRobot, or the config of TYPE.

    Those of installed third-party packages are among them.
    """

    type_: str | None = option(None, typed="TYPE", help="a device")

    def __call__(self) -> None:
        devices = _registry()
        if self.type_ is None:
            echo(f"LeRobot {devices['version']}")
            for kind, title in _KINDS.items():
                echo(f"{title} of type lerobot: {', '.join(devices[kind]) or 'none'}")
            return
        known = {kind: devices[kind][self.type_] for kind in _KINDS if self.type_ in devices[kind]}
        if not known:
            names = [name for kind in _KINDS for name in devices[kind]]
            raise RequestError(f"TYPE: LeRobot has no {self.type_!r}{did_you_mean(self.type_, names, 'it has')}")
        for kind, each in known.items():
            echo(f"{kind} {self.type_}: {each['module']}.{each['class']}")
            _show(each["fields"], "  ")


def _show(fields: Mapping[str, Any], indent: str) -> None:
    for name, field in fields.items():
        default = "required" if field["required"] else f"default {field.get('default')}"
        echo(f"{indent}{name}: {' or '.join(field['type'])}; {default}")
        _show(field.get("fields", {}), f"{indent}  ")


@attrs.frozen(kw_only=True)
class NewRobot:
    """Write a robot YAML for ROBOT, e.g. koch_follower, to OUT."""

    out: Path = option(typed="OUT", help="the new file")
    robot: str = option(typed="ROBOT", help="a robot of LeRobot's")
    id_: str | None = option(
        None, typed="--id ID", help="LeRobot's id of it, the name of its calibration; by default ROBOT"
    )
    units: tuple[str, ...] = option(
        (),
        typed="--unit [NAME=]UNIT",
        help=f"unit of the joint or axis NAME, or of all joints, where LeRobot does not say it: {', '.join(UNITS)}",
    )

    def __call__(self) -> None:
        from ibrobot_lerobot_devices.new_robot import write_robot

        given: dict[str, str] = {}
        for each in self.units:
            name, equals, unit = each.rpartition("=")
            if unit not in UNITS:
                raise RequestError(f"--unit: {unit!r}{did_you_mean(unit, UNITS, 'it is one of')}")
            given[name if equals else OTHERS] = unit
        with wrong_input():
            written = write_robot(self.out, self.robot, self.id_ or self.robot, given)
        echo(f"{self.out}: {written.type}, {counted(len(written.mapped), 'joint')}")
        if not written.measured:
            name = self.id_ or self.robot
            echo(f"note: limits of joints are guesses, since LeRobot has no calibration {name}: check them")
        if written.unknown_leader:
            echo(f"note: the file has no leader: {written.unknown_leader}")
        echo(f"try it: `ibrobot launch {self.out}`")


@attrs.frozen(kw_only=True)
class TorqueOff:
    """Switch the torque of ROBOT off, e.g. koch_follower."""

    robot: str = option(typed="ROBOT", help="a robot of LeRobot's")
    config: str = option(typed="--config JSON", help='LeRobot\'s config of it, e.g. \'{"port": "/dev/ttyACM0"}\'')
    yes: bool = option(False, help="switch off without asking")

    def __call__(self) -> None:
        try:
            values = json.loads(self.config)
        except ValueError as error:
            raise RequestError(f"--config: is not JSON: {error}") from None
        echo("Without torque the arm falls: hold it, or check that it rests on something.")
        if not (self.yes or confirm("Torque off?", flag="--yes")):
            raise Declined
        link = DeviceLink("robot", self.robot, values)
        try:
            if not link.start(_START_S)["torque"]:
                raise HardwareError(f"LeRobot's {self.robot} has no call that switches the torque off")
            link.call("relax", _START_S)
        except DeviceProblem as problem:
            raise HardwareError(f"{self.robot}: {problem}") from None
        finally:
            link.end()
        echo(f"torque off: {self.robot}")


def _registry() -> Mapping[str, Any]:
    try:
        return registry()
    except DeviceProblem as problem:
        raise HardwareError(str(problem)) from None
