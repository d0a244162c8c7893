"""`ibrobot feetech monitor`: shows the state of the servos, live; it only reads."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from typing import Any

import attrs
from ibrobot_terminal.screen import Screen, styled
from rich.console import Group
from rich.live import Live
from rich.table import Table

from ibrobot_core.api import option
from ibrobot_core.app import echo
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import table
from ibrobot_feetech.commands.joints import Joint, by_servo, joints_of
from ibrobot_feetech.commands.ports import OnPort, opened
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


@attrs.frozen(kw_only=True)
class Monitor(OnPort):
    """Show the state of every servo.

    It shows position, speed, load, temperature, voltage, current and errors. Ctrl-C ends it.
    """

    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    period: float = option(0.1, ge=0.01, unit="s", help="reading interval")
    once: bool = option(False, help="print one reading, then exit")
    as_json: bool = option(False, typed="--json", help="print one line of JSON per reading")

    def __call__(self) -> None:
        joints = joints_of(self.robot)
        with opened(self.port, joints=by_servo(joints)) as bus:
            reader = SyncReader(bus, [joint.servo for joint in joints], "present_position", "present_current")
            try:
                if self.as_json:
                    while True:
                        echo(json.dumps({"servos": reading(reader, joints), "bus": dict(bus.counters)}))
                        if self.once:
                            return
                        time.sleep(self.period)
                console = Screen()
                if self.once or not console.is_terminal:
                    console.print(_panel(bus, reader, joints))
                    while not self.once:
                        time.sleep(self.period)
                        console.print(_panel(bus, reader, joints))
                    return
                with Live(_panel(bus, reader, joints), console=console, auto_refresh=False) as live:
                    while True:
                        time.sleep(self.period)
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
