"""An arm with Damiao motors, as hardware of the control loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import override

import numpy as np

from ibrobot_core.api import (
    Condition,
    Context,
    Hardware,
    HardwareError,
    Holding,
    JointReading,
    Severity,
    Signal,
    Torque,
    Vector,
    nan_vector,
    seconds,
)
from ibrobot_damiao.bus import BusError, Channel, DamiaoBus, NoAnswer, TorqueStaysOn
from ibrobot_damiao.options import DamiaoOptions
from ibrobot_damiao.protocol import CLEAR_ERROR, ENABLE, ERRORS, MIT, MODE, ON, Feedback, MitCommand, command

_ANSWERS = 0.4
"""Fraction of a tick within which motors must answer."""
_END = 1.5 / 65535
"""Fraction of a range, at its ends, in which a motor reports positions beyond it."""
_MARGIN = 2.0
"""How far a temperature must fall below its level to end a condition [deg C]."""
_QUANTITIES = {0x8: "voltage", 0x9: "voltage", 0xA: "current", 0xD: "communication", 0xE: "load"}
"""Error -> affected quantity; the others are temperatures."""
_REMEDIES = {
    "voltage": "check the power supply and its cables",
    "current": "check whether something blocks the joint",
    "temperature": "let the arm rest without load",
    "communication": "no command came in time; check the CAN cable",
    "load": "check whether something blocks or loads the joint",
}


class DamiaoArm(Hardware):
    """Damiao motors on one CAN bus: each tick asks all for feedback, and sends each a position in MIT mode.

    Readings of motors that do not answer in time repeat their last state and are stale, for up to `lost_replies` ticks.
    Then it is a fault, and until `reset_faults`, `read` fails without waiting, as after an error of the bus. Errors of
    motors and temperatures are in `health`.

    Args:
        options: options from the YAML.
        ctx: its `joints` are those of the motors, in the order of the vectors.
    """

    def __init__(self, options: DamiaoOptions, ctx: Context) -> None:
        for fault in options.check(ctx.robot, ctx.joints):
            raise HardwareError(f"{ctx.name}: {'.'.join(map(str, fault.option))}: {fault.message}")
        self.joints = ctx.joints
        self._options = options
        self._ctx = ctx
        motors = [options.motors[joint] for joint in ctx.joints]
        self._ids = tuple(motor.id for motor in motors)
        self._sign: Vector = np.array([-1.0 if motor.inverted else 1.0 for motor in motors])
        self._zero: Vector = np.array([motor.zero for motor in motors])
        columns = ctx.robot.indices(ctx.joints)
        limits = np.stack([ctx.robot.lower[columns], ctx.robot.upper[columns]])
        self._limits = self._sign * (limits - self._zero)  # as positions of the motors
        self._gains = [(motor.kp, motor.kd) for motor in motors]
        channel = Channel(options.channel, options.interface, options.bitrate, options.data_bitrate)
        self._bus = DamiaoBus(channel, dict(zip(self._ids, ctx.joints, strict=True)), options.retries)
        size = len(ctx.joints)
        self.signals = (
            Signal(f"/{ctx.name}/temperature", size, "of each motor's coil [deg C]"),
            Signal(f"/{ctx.name}/driver_temperature", size, "of each motor's driver [deg C]"),
        )
        self._answers_s = _ANSWERS * seconds(ctx.period_ns)
        self._lost = np.zeros(size, dtype=np.intp)
        self._lost_replies = 0
        self._last: list[Feedback] = []
        self._hot: dict[int, Severity] = {}
        self._conditions: tuple[Condition, ...] = ()
        self._fault: HardwareError | None = HardwareError(f"{ctx.name}: not connected")
        self._relaxed = self._holding = False

    @override
    def connect(self) -> None:
        self._bus.open()
        self._relaxed = False
        try:
            self._find()
            for index in range(len(self._ids)):
                self._hold(index)
            self._start()
        except BaseException:
            if self._holding:
                self._quietly_relax()
            self._bus.close()
            raise

    @override
    def read(self) -> JointReading:
        if self._fault is not None:
            raise self._fault
        begun_ns = self._ctx.clock.now_ns()
        try:
            replies = self._bus.refresh(self._ids, self._answers_s)
        except BusError as error:
            self._fault = error
            raise
        stamp_ns = (begun_ns + self._ctx.clock.now_ns()) // 2
        for index, motor in enumerate(self._ids):
            if motor in replies:
                self._last[index], self._lost[index] = replies[motor], 0
            else:
                self._lost[index] += 1
                self._lost_replies += 1
        if (gone := np.flatnonzero(self._lost > self._options.lost_replies)).size:
            others = f", nor do {', '.join(self.joints[i] for i in gone[1:])}" if len(gone) > 1 else ""
            when = f" for {self._options.lost_replies + 1} ticks{others}"
            first = int(gone[0])
            self._fault = NoAnswer(f"{self._place(first)}: {self._bus.silence(self._ids[first], when)}")
            raise self._fault
        self._conditions = tuple(self._examine())
        last = self._last
        return JointReading(
            stamp_ns,
            self._joint_angles(np.array([feedback.position for feedback in last])),
            self._sign * np.array([feedback.velocity for feedback in last]),
            self._sign * np.array([feedback.torque for feedback in last]),
            stale=bool(self._lost.any()),
        )

    @override
    def write(self, position: Vector) -> None:
        if np.shape(position) != (len(self.joints),) or not np.isfinite(position).all():
            raise HardwareError(f"{self._ctx.name}: expected {len(self.joints)} finite positions, got {position}")
        if not self._bus.is_open:
            raise HardwareError(f"{self._ctx.name}: not connected")
        if self._relaxed:
            for index in range(len(self._ids)):
                self._hold(index)
            self._relaxed = False
        for motor, goal, (kp, kd) in zip(self._ids, self._sign * (position - self._zero), self._gains, strict=True):
            self._bus.command(motor, MitCommand(float(goal), kp, kd))

    @override
    def relax(self) -> Torque:
        self._relaxed = True
        try:
            self._bus.switch_off(self._ids)
        except TorqueStaysOn:
            raise
        except HardwareError as error:
            self._ctx.log.warning("cannot confirm that the torque is off: %s", error)
            return Torque.UNKNOWN
        self._holding = False
        return Torque.OFF

    @override
    def holding(self) -> Holding | None:
        if not self._holding:
            return None
        ids = "".join(f" --id {motor}" for motor in self._ids)
        return Holding(self._options.channel, f"ibrobot damiao off {self._bus.channel.arguments}{ids}")

    @override
    def health(self) -> Sequence[Condition]:
        return self._conditions

    @override
    def reset_faults(self) -> None:
        troubled = [index for index, feedback in enumerate(self._last) if feedback.state != ON and not self._relaxed]
        if self._fault is None and not troubled:
            return
        if isinstance(self._fault, BusError) or not self._bus.is_open:
            self._bus.close()
            self._bus.open()
        self._find()
        for index, motor in enumerate(self._ids):
            state = self._bus.ask(motor).state
            if state in ERRORS:
                state = self._bus.ask(motor, command(CLEAR_ERROR)).state
            if state in ERRORS:
                quantity = _QUANTITIES.get(state, "temperature")
                raise HardwareError(f"{self._place(index)}: still reports {ERRORS[state]}; {_REMEDIES[quantity]}")
            if state != ON and not self._relaxed:
                self._hold(index)
        self._start()

    @override
    def disconnect(self) -> None:
        self._fault = HardwareError(f"{self._ctx.name}: not connected")
        self._bus.close()

    @override
    def counters(self) -> Mapping[str, int]:
        return {**self._bus.counters, "lost_replies": self._lost_replies}

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        if not self._last:
            out[:] = nan_vector(len(self.joints))
            return
        out[:] = [feedback.driver if index else feedback.coil for feedback in self._last]

    def _joint_angles(self, position: Vector) -> Vector:
        """Motors' positions [rad] -> joint positions [rad], shape (J,)."""
        return self._sign * position + self._zero

    def _find(self) -> None:
        """Find all motors, and put them into MIT mode.

        Raises:
            HardwareError: names all motors that do not answer.
        """
        missing = []
        for motor in self._ids:
            try:
                self._bus.find(motor)
            except NoAnswer as error:
                missing.append(motor)
                last = error
                continue
            self._check_range(self._ids.index(motor))
            if self._bus.read(motor, MODE) != MIT:
                if self._bus.ask(motor).state == ON:
                    raise HardwareError(
                        f"{self._bus.place(motor)}: its torque is on in another mode than MIT mode, and a change could "
                        f"move it; hold the arm, and `ibrobot damiao off {self._bus.channel.arguments} --id {motor}`"
                    )
                self._bus.write(motor, MODE, MIT)
        if len(missing) > 1:
            names = ", ".join(f"{motor} ({self.joints[self._ids.index(motor)]})" for motor in missing)
            raise NoAnswer(f"{self._bus.place()}: no answer from motors {names}; check their power and cables")
        if missing:
            raise last

    def _check_range(self, index: int) -> None:
        """Check that a motor's frames reach to the limits of its joint; beyond, it would stop in silence.

        Raises:
            HardwareError: if they do not.
        """
        end = self._bus.motors[self._ids[index]].ranges.position
        reach = self._limits[:, index]
        if np.abs(reach).max() > end:
            raise HardwareError(
                f"{self._place(index)}: the joint's lower and upper are {reach.min():g} and {reach.max():g} rad of the "
                f"motor, beyond its range of {end:g} rad either way (register PMAX); narrow the limits, correct "
                "`zero`, or raise PMAX with the motor's software"
            )

    def _beyond(self, index: int, feedback: Feedback) -> str:
        """Why the position in a feedback is not that of the motor; empty if it is."""
        end = self._bus.motors[self._ids[index]].ranges.position
        if abs(feedback.position) < end * (1 - _END):
            return ""
        return (
            f"{self._place(index)}: is at or beyond the end of its range of {end:g} rad either way (register PMAX), so "
            "its position is unknown; take its torque off, turn the joint back by hand, or set its zero with "
            "`ibrobot damiao zero`"
        )

    def _hold(self, index: int) -> None:
        """Switch a motor's torque on, where it is, so that the joint does not jump.

        Raises:
            HardwareError: if the motor reports an error, does not switch its torque on, or is beyond its range.
        """
        motor, (kp, kd) = self._ids[index], self._gains[index]
        feedback = self._bus.ask(motor)
        if feedback.state in ERRORS:
            feedback = self._bus.ask(motor, command(CLEAR_ERROR))
        if reason := self._beyond(index, feedback):
            raise HardwareError(reason)
        # A motor goes on with the last command it had, so it gets the new one before its torque.
        here = MitCommand(feedback.position, kp, kd).encode(self._bus.motors[motor].ranges)
        self._bus.ask(motor, here)
        self._holding = True
        self._bus.ask(motor, command(ENABLE))
        state = self._bus.ask(motor, here).state
        if state != ON:
            reason = ERRORS.get(state, "its torque stays off")
            quantity = _QUANTITIES.get(state, "temperature") if state in ERRORS else "voltage"
            raise HardwareError(f"{self._place(index)}: cannot hold: {reason}; {_REMEDIES[quantity]}")

    def _start(self) -> None:
        """Start reading; every motor must answer."""
        self._last = [self._bus.ask(motor) for motor in self._ids]
        self._lost[:] = 0
        self._hot.clear()
        self._conditions = ()
        self._fault = None

    def _quietly_relax(self) -> None:
        try:
            self.relax()
        except TorqueStaysOn as error:
            self._ctx.log.warning("%s", error)

    def _place(self, index: int) -> str:
        return self._bus.place(self._ids[index])

    def _examine(self) -> list[Condition]:
        """Present conditions of all motors."""
        conditions = []
        for index, feedback in enumerate(self._last):
            joint, place = self.joints[index], self._place(index)
            if feedback.state in ERRORS:
                quantity = _QUANTITIES.get(feedback.state, "temperature")
                message = f"{place}: the motor reports {ERRORS[feedback.state]} and has switched its torque off; "
                conditions.append(Condition(joint, quantity, 1.0, "", Severity.FAULT, message + _REMEDIES[quantity]))
                continue
            if feedback.state != ON and not self._relaxed:
                message = (
                    f"{place}: its torque went off by itself, as after a loss of power; check the power supply and the "
                    "motor's cable; a reset switches it on"
                )
                conditions.append(Condition(joint, "torque", 0.0, "", Severity.FAULT, message))
            if reason := self._beyond(index, feedback):
                conditions.append(Condition(joint, "position", feedback.position, "rad", Severity.FAULT, reason))
            if (hot := self._temperature(index, max(feedback.coil, feedback.driver))) is not None:
                conditions.append(hot)
        return conditions

    def _temperature(self, index: int, value: float) -> Condition | None:
        """The condition of a motor's temperature [deg C]; to end one, it must fall by a margin."""
        options = self._options
        known = self._hot.pop(index, None)
        for name, level, severity in (
            ("max_temperature", options.max_temperature, Severity.FAULT),
            ("warning_temperature", options.warning_temperature, Severity.WARNING),
        ):
            if value > level - (_MARGIN if known in (severity, Severity.FAULT) else 0.0):
                self._hot[index] = severity
                message = f"{self._place(index)}: temperature {value:.0f} deg C, above {name} ({level:g} deg C); "
                return Condition(
                    self.joints[index], "temperature", value, "deg C", severity, message + _REMEDIES["temperature"],
                    sheds_load=True,
                )  # fmt: skip
        return None
