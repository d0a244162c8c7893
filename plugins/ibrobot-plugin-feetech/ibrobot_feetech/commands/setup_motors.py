"""`ibrobot feetech setup-motors`: sets each servo's id and baud rate, one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import attrs
from ibrobot_terminal import Guide
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import HardwareError, option
from ibrobot_core.app import RequestError
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.dialogue import TerminalGuide
from ibrobot_feetech.commands.joints import Joint, by_servo, chosen, joints_of
from ibrobot_feetech.commands.ports import OnPort, opened
from ibrobot_feetech.commands.scan import rates_of, rates_option, search
from ibrobot_feetech.errors import NoReply
from ibrobot_feetech.registers import BAUD_RATES, MODEL_STS3215

_RATE = 1_000_000


@attrs.frozen(kw_only=True)
class SetUpMotors(OnPort):
    """Set the id and the baud rate of each servo, one by one.

    Only one servo is connected at a time, beginning with the last joint. The baud rate becomes 1 Mbaud.
    """

    names: tuple[str, ...] = option((), typed="--joint NAME", help="only this joint; may be repeated")
    robot: str | None = option(None, typed="--robot CONFIG", help="robot YAML with the joints; by default an SO-101")
    baud: str = rates_option("all", "rates at which to look for the servo")
    yes: bool = option(False, help="the servo is connected: do not ask; needs exactly one --joint")

    def __call__(self) -> None:
        if self.yes and len(self.names) != 1:
            raise RequestError("--yes needs exactly one --joint, because only one servo may be connected")
        set_up_motors(TerminalGuide(), self.port, self.names, robot=self.robot, rates=rates_of(self.baud), yes=self.yes)


def set_up_motors(
    guide: Guide, port: str | None, names: Sequence[str] = (), *, robot: str | None = None,
    rates: Sequence[int] = tuple(BAUD_RATES), yes: bool = False,
) -> None:  # fmt: skip
    """Set up servos with an operator, who connects one at a time; the arguments are those of the command.

    Raises:
        Declined: if the operator gives up.
        HardwareError: if a servo cannot be set up and nobody can be asked.
    """
    every = joints_of(robot)
    with opened(port, joints=by_servo(every)) as bus:
        for joint in reversed(chosen(every, names)):
            _set_up(bus, guide, joint, rates, yes)
    guide.say("Now connect the servos in a chain; `ibrobot feetech scan` must show all of them.")


def _set_up(bus: FeetechBus, guide: Guide, joint: Joint, rates: Sequence[int], yes: bool) -> None:
    while True:
        if not yes:
            guide.wait(f"Connect only the servo of {joint.name} (id {joint.servo}), and power.", flag="--yes")
        try:
            servo, rate = _the_only_one(bus, joint, rates)
            _assign(bus, servo, rate, joint)
        except HardwareError as error:
            if yes:
                raise
            guide.say(f"error: {error}", warning=True)
            if not guide.confirm("Try again?", flag="--yes", default=True):
                raise Declined from None
        else:
            guide.say(f"{joint.name}: was id {servo} at {rate} baud, is id {joint.servo} at {_RATE} baud")
            return


def _the_only_one(bus: FeetechBus, joint: Joint, rates: Sequence[int]) -> tuple[int, int]:
    """Id and baud rate of the connected servo.

    Raises:
        HardwareError: if none or several answer, or it is another model.
    """
    damaged = bus.counters["bad_packets"]
    models = search(bus, rates)
    where = f"{bus.port.path}, {joint.name}"
    if not models:
        if bus.counters["bad_packets"] > damaged:
            raise HardwareError(f"{where}: the answers are damaged, so several servos share an id; connect only one")
        raise HardwareError(f"{where}: no servo answers at {len(rates)} baud rates; check its power and its cable")
    if len(models) > 1:
        who = ", ".join(f"id {servo} at {rate} baud" for servo, rate in models)
        raise HardwareError(f"{where}: {len(models)} servos answer ({who}); connect only that of {joint.name}")
    (servo, rate), model = next(iter(models.items()))
    if model != MODEL_STS3215:
        raise HardwareError(f"{where}: servo {servo} is model {model}; an STS3215 is {MODEL_STS3215}")
    return servo, rate


def _assign(bus: FeetechBus, servo: int, rate: int, joint: Joint) -> None:
    """Set and lock the servo's id, baud rate and position mode."""
    bus.port.set_baud_rate(rate)
    bus.write(servo, "torque_enable", 0)
    bus.write(servo, "lock", 0)
    bus.write(servo, "operating_mode", 0)
    # Firmware versions differ in whether the acknowledgement has the old or the new id and rate.
    with suppress(NoReply):
        bus.write(servo, "id", joint.servo)
    with suppress(NoReply):
        bus.write(joint.servo, "baud_rate", BAUD_RATES[_RATE])
    bus.port.set_baud_rate(_RATE)
    bus.write(joint.servo, "lock", 1)
    stored = bus.read(joint.servo, "id"), bus.read(joint.servo, "baud_rate")
    if stored != (joint.servo, BAUD_RATES[_RATE]):
        raise HardwareError(f"{bus.place(joint.servo)}: its id and rate code are {stored} after being set; try again")
