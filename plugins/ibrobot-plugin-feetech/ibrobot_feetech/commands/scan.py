"""`ibrobot feetech scan`: lists the servos on the bus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import attrs

from ibrobot_core.api import HardwareError, option
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import by_servo, joints_of
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.errors import PortError
from ibrobot_feetech.registers import BAUD_RATES, MODEL_STS3215


def rates_option(default: str, help: str) -> Any:
    """An option for a baud rate, or `all`; see `rates_of`."""
    return option(default, choices=("all", *map(str, BAUD_RATES)), help=help)


def rates_of(text: str) -> tuple[int, ...]:
    """The rates to try [baud]."""
    return tuple(BAUD_RATES) if text == "all" else (int(text),)


@attrs.frozen(kw_only=True)
class Scan(OnPort):
    """List the servos that answer: id, model, firmware, baud rate. Exit with 1 if there are none."""

    baud: str = rates_option("1000000", "baud rate to use")

    def __call__(self) -> None:
        baud = rates_of(self.baud)
        names = by_servo(joints_of())
        rows = []
        with opened(self.port, baud[0], patience_s=0.0) as bus:  # most ids have no servo
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
