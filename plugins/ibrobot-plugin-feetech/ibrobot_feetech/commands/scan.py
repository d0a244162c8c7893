"""`ibrobot feetech scan`: lists the servos on the bus."""

from __future__ import annotations

from collections.abc import Sequence

import click

from ibrobot_core.api import HardwareError
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import by_servo, joints_of
from ibrobot_feetech.commands.ports import opened, port_argument
from ibrobot_feetech.errors import PortError
from ibrobot_feetech.registers import BAUD_RATES, MODEL_STS3215


class BaudRates(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions only
    """One baud rate, or `all`."""

    name = "all|N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """The rates to try [baud]."""
        if isinstance(value, tuple):
            return value
        if value == "all":
            return tuple(BAUD_RATES)
        if str(value).isdigit() and int(str(value)) in BAUD_RATES:
            return (int(str(value)),)
        return self.fail(f"{value!r} is not one of: all, {', '.join(map(str, BAUD_RATES))}", param, ctx)


@click.command()
@port_argument
@click.option("--baud", type=BaudRates(), default="1000000", show_default=True, help="Baud rate to use.")
def scan(port: str | None, baud: tuple[int, ...]) -> None:
    """List the servos that answer: id, model, firmware, baud rate. Exit with 1 if there are none."""
    names = by_servo(joints_of())
    rows = []
    with opened(port, baud[0], patience_s=0.0) as bus:  # most ids have no servo
        for (servo, rate), model in search(bus, baud).items():
            bus.port.set_baud_rate(rate)
            kind = "STS3215" if model == MODEL_STS3215 else str(model)
            rows.append((str(servo), names.get(servo, ""), kind, bus.firmware(servo), str(rate)))
        if not rows:
            at = f"{baud[0]} baud" if len(baud) == 1 else "any baud rate"
            more = " and other rates (--baud all)" if len(baud) == 1 else ""
            raise HardwareError(
                f"{bus.port.path}: no servo answers at {at}; check the arm's power supply, the cable to its first "
                f"servo, the jumpers of the board (USB){more}"
            )
    TerminalGuide().show((">id", "joint of an SO-101", "model", "firmware", ">baud"), rows)


def search(bus: FeetechBus, rates: Sequence[int]) -> dict[tuple[int, int], int]:
    """Find servos; returns (servo id, baud rate) -> model.

    A broadcast asks all ids at each rate. Only if it finds no servo at any rate, each id is asked, which takes longer.

    Raises:
        PortError: if the port is gone.
    """
    for one_by_one in (False, True):
        models: dict[tuple[int, int], int] = {}
        for rate in rates:
            try:
                bus.port.set_baud_rate(rate)
            except PortError:  # the port does not support this rate
                if len(rates) == 1:
                    raise
                continue
            models |= {(servo, rate): model for servo, model in bus.scan(one_by_one=one_by_one).items()}
        if models:
            break
    return models
