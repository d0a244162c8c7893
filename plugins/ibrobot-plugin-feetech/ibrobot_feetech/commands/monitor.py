"""`ibrobot feetech monitor`: shows the state of the servos, live; it only reads."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import click
from rich.console import Group
from rich.live import Live
from rich.table import Table

from ibrobot_core.app import Screen, echo, styled
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import table
from ibrobot_feetech.commands.joints import Joint, by_servo, joints_of
from ibrobot_feetech.commands.ports import opened, port_argument
from ibrobot_feetech.protocol import faults
from ibrobot_feetech.sync import SyncReader
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_TURN

_UNITS = {
    "velocity_deg_s": ("present_velocity", 360 / 4096),
    "load_percent": ("present_load", 0.1),
    "temperature_c": ("present_temperature", 1.0),
    "voltage_v": ("present_voltage", 0.1),
    "current_a": ("present_current", 0.0065),
}


@click.command()
@port_argument
@click.option("--robot", metavar="CONFIG", help="Robot YAML with the joints; by default an SO-101.")
@click.option("--period", type=click.FloatRange(0.01), default=0.1, show_default=True, help="Reading interval [s].")
@click.option("--once", is_flag=True, help="Print one reading, then exit.")
@click.option("--json", "as_json", is_flag=True, help="Print one line of JSON per reading.")
def monitor(port: str | None, robot: str | None, period: float, once: bool, as_json: bool) -> None:
    """Show the state of every servo.

    It shows position, speed, load, temperature, voltage, current and errors. Ctrl-C ends it.
    """
    joints = joints_of(robot)
    with opened(port, joints=by_servo(joints)) as bus:
        reader = SyncReader(bus, [joint.servo for joint in joints], "present_position", "present_current")
        try:
            if as_json:
                while True:
                    echo(json.dumps({"servos": reading(reader, joints), "bus": dict(bus.counters)}))
                    if once:
                        return
                    time.sleep(period)
            console = Screen()
            if once or not console.is_terminal:
                console.print(_panel(bus, reader, joints))
                while not once:
                    time.sleep(period)
                    console.print(_panel(bus, reader, joints))
                return
            with Live(_panel(bus, reader, joints), console=console, auto_refresh=False) as live:
                while True:
                    time.sleep(period)
                    live.update(_panel(bus, reader, joints), refresh=True)
        except KeyboardInterrupt:
            return


def reading(reader: SyncReader, joints: Sequence[Joint]) -> list[dict[str, Any]]:
    """A reading of each servo, in human units; for a servo that does not answer, only an error."""
    replies = reader.read()
    rows: list[dict[str, Any]] = []
    for row, joint in enumerate(joints):
        servo: dict[str, Any] = {"id": joint.servo, "joint": joint.name, "answers": bool(replies.answered[row])}
        if servo["answers"]:
            values = dict(zip(reader.registers, replies.values[row].tolist(), strict=True))
            servo["position_ticks"] = values["present_position"]
            servo["position_deg"] = round((values["present_position"] - MIDDLE_TICK) * 360 / TICKS_PER_TURN, 2)
            servo |= {name: round(values[register] * unit, 3) for name, (register, unit) in _UNITS.items()}
            servo["errors"] = list(faults(int(replies.errors[row]) | values["status"]))
        rows.append(servo)
    return rows


def _panel(bus: FeetechBus, reader: SyncReader, joints: Sequence[Joint]) -> Group:
    rows = _rows(reading(reader, joints))
    counts = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in bus.counters.items())
    return Group(rows, styled(counts, style="dim"))


def _rows(servos: Sequence[Mapping[str, Any]]) -> Table:
    made = table(">id", "joint", ">ticks", ">deg", ">deg/s", ">load %", ">°C", ">V", ">A", "errors")
    for servo in servos:
        name = str(servo["id"]), servo["joint"]
        if not servo["answers"]:
            made.add_row(*name, *[""] * 7, styled("no reply", style="red"))
            continue
        errors = styled(", ".join(servo["errors"]) or "none", style="red" if servo["errors"] else "")
        made.add_row(
            *name, str(servo["position_ticks"]), f"{servo['position_deg']:.1f}", f"{servo['velocity_deg_s']:.0f}",
            f"{servo['load_percent']:.0f}", f"{servo['temperature_c']:.0f}", f"{servo['voltage_v']:.1f}",
            f"{servo['current_a']:.2f}", errors,
        )  # fmt: skip
    return made
