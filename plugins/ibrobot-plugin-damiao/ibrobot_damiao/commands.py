"""`ibrobot damiao scan`, `zero`, `off` and `set-id`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager

import attrs
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined, confirm

from ibrobot_core.api import HardwareError, option
from ibrobot_core.app import RequestError, echo, find_config, installed_plugins, load_config, wrong_input
from ibrobot_damiao.bus import BusError, Channel, DamiaoBus, NoAnswer
from ibrobot_damiao.options import DamiaoOptions
from ibrobot_damiao.protocol import DEFAULT_BITRATE, DISABLE, ERRORS, OFF, ON, SAVE_ZERO, command

_RETRIES = 5
"""Retries of the commands, which have no deadline."""
_STATES = {OFF: "off", ON: "on", **ERRORS}
_STILL = 0.02
"""How far from 0 a motor may be after its zero was set [rad]."""


@attrs.frozen(kw_only=True)
class OnChannel:
    """The argument CHANNEL, and what opens it."""

    channel: str = option(typed="CHANNEL", help="e.g. can0, or the serial port of an adapter that speaks slcan")
    interface: str = option("", help="interface type of python-can; by default socketcan, or slcan for a serial port")
    bitrate: int = option(DEFAULT_BITRATE, unit="bit/s", gt=0, help="rate of the bus; socketcan takes it from ip link")
    data_bitrate: int | None = option(None, unit="bit/s", gt=0, help="rate of the data in CAN FD frames")

    @contextmanager
    def opened(self, names: Mapping[int, str] | None = None) -> Iterator[DamiaoBus]:
        """The bus, open.

        Raises:
            HardwareError: if it cannot be opened.
        """
        bus = DamiaoBus(Channel(self.channel, self.interface, self.bitrate, self.data_bitrate), names, retries=_RETRIES)
        with wrong_input():
            bus.open()
        try:
            yield bus
        finally:
            bus.close()


@attrs.frozen(kw_only=True)
class Scan(OnChannel):
    """List the motors that answer: id, feedback id, state, position, temperature.

    Exit with 1 if there are none, or one cannot be used.
    """

    last: int = option(16, ge=1, le=0x7E, help="greatest id that is asked")

    def __call__(self) -> None:
        rows, unusable = [], 0
        with self.opened() as bus:
            bus.retries = 2  # a lost answer hides no motor, though most ids have none
            for motor in range(1, self.last + 1):
                try:
                    if not _is_there(bus, motor, must=False):
                        continue
                    motor_there, feedback = bus.motors[motor], bus.ask(motor)
                except BusError:
                    raise
                except HardwareError as error:
                    unusable += 1
                    rows.append(str(error))
                    continue
                state, span = _STATES[feedback.state], motor_there.ranges
                rows.append(
                    f"motor {motor}: feedback id {motor_there.feedback_id:#x}, torque {state}, "
                    f"{feedback.position:.3f} rad, coil {feedback.coil:.0f} deg C, ranges {span.position:g} rad, "
                    f"{span.velocity:g} rad/s, {span.torque:g} Nm"
                )
        if not rows:
            raise HardwareError(
                f"{self.channel}: no motor answers to ids 1 to {self.last}; check the motors' power, the cable's two "
                "120 ohm, and the rate of the bus"
            )
        for row in rows:
            echo(row)
        if unusable:
            raise HardwareError(
                f"{self.channel}: {unusable} of {counted(len(rows), 'motor')} cannot be used, see above"
            )


@attrs.frozen(kw_only=True)
class Zero:
    """Make the present pose of a robot's arm its zero pose, in the motors.

    Move the arm by hand into the pose in which each joint is at its `zero`, then confirm. The torque is switched off
    first. The motors keep it after power-off.
    """

    robot: str = option(typed="ROBOT", help="robot YAML with an arm of type damiao")
    names: tuple[str, ...] = option((), typed="--joint NAME", help="only this joint; may be repeated")
    arm: str | None = option(None, help="name of the hardware, if the robot has several arms of this type")
    yes: bool = option(False, help="the arm is in its zero pose: do not ask")

    def __call__(self) -> None:
        options = _arm_of(self.robot, self.arm)
        for name in self.names:
            if name not in options.motors:
                raise RequestError(f"--joint: no joint {name!r}; available: {', '.join(options.motors)}")
        joints = self.names or tuple(options.motors)
        ids = {options.motors[joint].id: joint for joint in joints}
        channel = OnChannel(
            channel=options.channel, interface=options.interface, bitrate=options.bitrate,
            data_bitrate=options.data_bitrate,
        )  # fmt: skip
        with channel.opened(ids) as bus:
            for motor in ids:
                bus.find(motor)
            echo("Without torque the arm falls: hold it, or check that it rests on something.")
            if not (self.yes or confirm("Torque off?", flag="--yes")):
                raise Declined
            bus.switch_off(tuple(ids))
            poses = ", ".join(f"{joint} at {options.motors[joint].zero:g} rad" for joint in joints)
            if not (self.yes or confirm(f"Move the arm to its zero pose ({poses}). Is it there?", flag="--yes")):
                raise Declined
            for motor, joint in ids.items():
                before = bus.ask(motor).position
                bus.ask(motor, command(SAVE_ZERO))
                if abs(now := bus.ask(motor).position) > _STILL:
                    raise HardwareError(f"{bus.place(motor)}: is at {now:.3f} rad after its zero was set; set it again")
                echo(f"{joint}: zero set; it was at {before:.3f} rad")


@attrs.frozen(kw_only=True)
class Off(OnChannel):
    """Switch motors off: those of ids 1 to 16, or of `--id`. The arm falls."""

    ids: tuple[int, ...] = option((), typed="--id", ge=1, le=0x7E, help="only this motor; may be repeated")
    yes: bool = option(False, help="do not ask")

    def __call__(self) -> None:
        with self.opened() as bus:
            present, troubled = [], {}
            for motor in self.ids or range(1, 17):
                try:
                    if _is_there(bus, motor, must=bool(self.ids)):
                        present.append(motor)
                except BusError:
                    raise
                except HardwareError as error:  # keeps no other motor's torque on, and may be a lost answer
                    troubled[motor] = error
            if not present and not troubled:
                raise HardwareError(f"{self.channel}: no motor answers to ids 1 to 16; check the motors' power")
            echo("Without torque the arm falls: hold it, or check that it rests on something.")
            if not (self.yes or confirm("Torque off?", flag="--yes")):
                raise Declined
            for motor in troubled:
                bus.send(motor, command(DISABLE))
            bus.switch_off(present)
        if present:
            echo(f"torque off: {_listed(present)}")
        if troubled:
            reasons = "; ".join(map(str, troubled.values()))
            raise HardwareError(f"torque off was sent to {_listed(troubled)}, but it is not confirmed: {reasons}")


@attrs.frozen(kw_only=True)
class SetId(OnChannel):
    """Give the only motor of the bus with id OLD the id NEW, and the feedback id NEW + 16, for good.

    Connect one motor at a time. Its torque is switched off.
    """

    old: int = option(typed="OLD", ge=1, le=0x7E, help="its present id")
    new: int = option(typed="NEW", ge=1, le=0x6E, help="its new id")

    def __call__(self) -> None:
        with self.opened() as bus:
            bus.find(self.old)
            if self.new != self.old and _is_there(bus, self.new, must=False):
                raise RequestError(f"NEW: a motor has id {self.new} already; connect one motor at a time")
            bus.switch_off([self.old])
            bus.set_id(self.old, self.new)
        echo(f"motor {self.old} is motor {self.new}, with feedback id {self.new + 0x10:#x}")


def _listed(motors: Iterable[int]) -> str:
    return ", ".join(f"motor {motor}" for motor in motors)


def _is_there(bus: DamiaoBus, motor: int, *, must: bool) -> bool:
    try:
        bus.find(motor)
    except NoAnswer:
        if must:
            raise
        return False
    return True


def _arm_of(robot: str, name: str | None) -> DamiaoOptions:
    registry = installed_plugins()
    config = load_config(find_config(robot, registry))
    arms = {key: part.options for key, part in config.hardware.items() if isinstance(part.options, DamiaoOptions)}
    if name is not None and name not in arms:
        raise RequestError(f"--arm: no arm {name!r} of type damiao in {robot}; it has: {', '.join(arms) or 'none'}")
    if len(arms) > 1 and name is None:
        raise RequestError(f"{robot} has several arms of type damiao: {', '.join(arms)}; choose one with --arm")
    if not arms:
        raise RequestError(f"{robot} has no hardware of type damiao")
    return arms[name] if name is not None else next(iter(arms.values()))
