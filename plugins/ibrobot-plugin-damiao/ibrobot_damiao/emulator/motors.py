"""Emulated Damiao motors, which answer frames and turn as time passes."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator

import attrs

from ibrobot_core.api import Clock, RealClock, seconds
from ibrobot_damiao.protocol import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    ERRORS,
    FEEDBACK_ID,
    MAX_POSITION,
    MAX_TORQUE,
    MAX_VELOCITY,
    MIT,
    MODE,
    MOTOR_ID,
    OFF,
    ON,
    REFRESH,
    REGISTER_ID,
    SAVE,
    SAVE_ZERO,
    TIMEOUT,
    Feedback,
    MitCommand,
    Ranges,
    Register,
)

_STEP_S = 0.0005
"""Step of the integration [s]."""
_LONGEST_S = 5.0
"""The most time that one advance makes up for [s]."""
_INERTIA, _FRICTION = 0.05, 0.3
"""Of a joint [kg m^2], [Nm s/rad]."""
_TIMEOUT_UNIT_S = 50e-6
_COMMUNICATION = 0xD
Frame = tuple[int, bytes]
"""CAN id and data."""


class EmulatedMotor:
    """A motor with a joint of some inertia and friction.

    Args:
        motor: its id.
        feedback_id: id of its answers; by default 16 more than its id.
        ranges: what the numbers in its frames span; by default those of a DM4310.
        load: torque of its load, e.g. of its weight [Nm].
    """

    def __init__(
        self, motor: int, *, feedback_id: int | None = None, ranges: Ranges | None = None, load: float = 0.0
    ) -> None:
        ranges = ranges or Ranges(12.5, 30.0, 10.0)
        self.registers: dict[int, float] = {
            FEEDBACK_ID: motor + 0x10 if feedback_id is None else feedback_id,
            MOTOR_ID: motor,
            TIMEOUT: 0,
            MODE: MIT,
            MAX_POSITION: ranges.position,
            MAX_VELOCITY: ranges.velocity,
            MAX_TORQUE: ranges.torque,
        }
        self.saved = dict(self.registers)
        """What the registers are after power-off."""
        self.load = load
        self.state = OFF
        self.angle = self.velocity = self.torque = 0.0
        """Of the joint [rad], [rad/s], [Nm]; `angle` counts from where the motor was made."""
        self.zero = 0.0
        """The angle at which it reports 0 [rad]."""
        self.driver = self.coil = 30.0
        """Temperatures [deg C]."""
        self.blocked = False
        self.silent = False
        """Whether it is without power or cable."""
        self._command = MitCommand(0.0, 0.0, 0.0)
        self._heard_s = 0.0

    @property
    def id(self) -> int:
        """Its CAN id."""
        return int(self.registers[MOTOR_ID])

    @property
    def ranges(self) -> Ranges:
        """What the numbers in its frames span."""
        return Ranges(*(self.registers[name] for name in (MAX_POSITION, MAX_VELOCITY, MAX_TORQUE)))

    def restart(self) -> None:
        """Lose power, and get it back: torque off, registers as saved."""
        self.registers, self.state = dict(self.saved), OFF
        self._command = MitCommand(0.0, 0.0, 0.0)

    def fail(self, state: int) -> None:
        """Report an error of `ERRORS`, which takes its torque off."""
        assert state in ERRORS
        self.state = state

    def feedback(self) -> Frame:
        """The frame that reports its present state."""
        feedback = Feedback(
            self.id, self.state, self.angle - self.zero, self.velocity, self.torque, self.driver, self.coil
        )
        return int(self.registers[FEEDBACK_ID]), feedback.encode(self.ranges)

    def receive(self, arbitration_id: int, data: bytes, now_s: float) -> Iterator[Frame]:
        """Process a frame, and yield the answers."""
        if self.silent or len(data) != 8:
            return
        if arbitration_id == self.id:
            self._heard_s = now_s
            self._obey(data)
            yield self.feedback()
        elif arbitration_id == REGISTER_ID and int.from_bytes(data[:2], "little") == self.id:
            if data[2] == SAVE and self.state == OFF:
                self.saved = dict(self.registers)
            elif data[2] == REFRESH:
                yield self.feedback()
            elif (request := Register.decode(data)) is not None and request.register in self.registers:
                if request.write:
                    self.registers[request.register] = request.value
                answer = attrs.evolve(request, value=self.registers[request.register])
                yield int(self.registers[FEEDBACK_ID]), answer.encode()

    def advance(self, step_s: float, now_s: float) -> None:
        """Turn for a step of time."""
        limit_s = self.registers[TIMEOUT] * _TIMEOUT_UNIT_S
        if self.state == ON and limit_s and now_s - self._heard_s > limit_s:
            self.fail(_COMMUNICATION)
        self.torque = 0.0
        if self.state == ON and self.registers[MODE] == MIT:
            wanted = self._command
            drive = (
                wanted.kp * (wanted.position - (self.angle - self.zero))
                + wanted.kd * (wanted.velocity - self.velocity)
                + wanted.torque
            )
            most = self.registers[MAX_TORQUE]
            self.torque = min(max(drive, -most), most)
        if self.blocked:
            self.velocity = 0.0
            return
        self.velocity += (self.torque + self.load - _FRICTION * self.velocity) / _INERTIA * step_s
        self.angle += self.velocity * step_s

    def _obey(self, data: bytes) -> None:
        if data[:7] == b"\xff" * 7 and data[7] in (ENABLE, DISABLE, SAVE_ZERO, CLEAR_ERROR):
            code = data[7]
            if code == ENABLE and self.state == OFF:
                self.state = ON
            elif code == DISABLE:
                self.state = OFF if self.state == ON else self.state
            elif code == SAVE_ZERO:
                self.zero = self.angle
            elif code == CLEAR_ERROR and self.state in ERRORS:
                self.state = OFF
        else:
            self._command = MitCommand.decode(data, self.ranges)


class EmulatedMotors:
    """Motors on one bus; they advance to the clock's time with each frame.

    Args:
        motors: the motors; ids need not differ, as on a bus that is wired before it is set up.
        clock: clock of their motion; None for the machine's.
    """

    def __init__(self, motors: Iterable[EmulatedMotor], clock: Clock | None = None) -> None:
        self.motors = list(motors)
        self.clock = clock or RealClock()
        """The clock of their motion."""
        self._now_ns = self.clock.now_ns()
        self.lock = threading.RLock()
        """Held while a frame is processed."""

    def __getitem__(self, motor: int) -> EmulatedMotor:
        """The motor with an id."""
        return next(each for each in self.motors if each.id == motor)

    def receive(self, arbitration_id: int, data: bytes) -> list[Frame]:
        """Advance to the present time, process a frame, and return the answers."""
        with self.lock:
            self.settle()
            now_s = seconds(self._now_ns)
            return [frame for motor in self.motors for frame in motor.receive(arbitration_id, data, now_s)]

    def settle(self) -> None:
        """Advance the motors to the clock's present time."""
        with self.lock:
            now_ns = self.clock.now_ns()
            passed_s = min(seconds(now_ns - self._now_ns), _LONGEST_S)
            steps = math.ceil(passed_s / _STEP_S)
            for i in range(steps):
                now_s = seconds(now_ns) - passed_s * (1 - (i + 1) / steps)
                for motor in self.motors:
                    motor.advance(passed_s / steps, now_s)
            self._now_ns = now_ns
