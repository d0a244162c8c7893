"""The follower: an SO-101 with STS3215 servos on one bus, as hardware of the control loop."""

from __future__ import annotations

import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import override

import numpy as np
from ibrobot_calibration import calibration_path, load_calibration
from numpy.typing import NDArray

from ibrobot_core.api import (
    Condition,
    Context,
    Hardware,
    HardwareError,
    Holding,
    IbrobotError,
    JointReading,
    Signal,
    Torque,
    Vector,
    nan_vector,
    ns,
    seconds,
)
from ibrobot_feetech import arm as servos
from ibrobot_feetech.arm import Arm, Tuning
from ibrobot_feetech.bus import RETURN_DELAY_S, FeetechBus
from ibrobot_feetech.errors import FeetechError, NoReply, Place, PortError, ServoFault, TorqueStaysOn
from ibrobot_feetech.health import Health, Measured, SteadyLoad
from ibrobot_feetech.opening import open_port
from ibrobot_feetech.options import TOOL, FollowerOptions
from ibrobot_feetech.port import emulate, is_device
from ibrobot_feetech.protocol import OVER_CURRENT, OVERLOAD, faults
from ibrobot_feetech.supply import supply
from ibrobot_feetech.sync import Replies, SyncReader, SyncWriter
from ibrobot_feetech.ticks import TICKS_PER_RADIAN
from ibrobot_feetech.usb import check_adapter

_SLACK_TICKS = 16
"""Allowed distance of a position from the one predicted by the last position and speed [ticks]."""
_MAX_ACCELERATION, _MAX_SPEED = 40_000, 4_000
"""Maximum acceleration and additional speed of a joint [ticks/s^2, ticks/s]."""
_AGAIN = 0.4
"""Fraction of a tick within which servos without a valid reply are asked again."""
_HEALTH_AGAIN_S = 0.05
"""Delay before an incomplete health read is repeated [s]; long replies are damaged more often."""
_VOLTAGE_V, _CURRENT_A, _LOAD = 0.1, 0.0065, 1e-3


class FeetechFollower(Hardware):
    """An SO-101 on its servo bus: one sync read of position, velocity and load and one sync write of goals per tick.

    If a reply is lost, damaged or implausible, readings repeat the joint's last state and are stale, for up to
    `lost_replies` ticks. Then it is a fault, and until `reset_faults`, `read` fails without waiting. Errors that servos
    report are in `health`; they do not affect `read`. `reset_faults` configures servos that lost power, torque or
    connection, or that report errors; a gripping joint in overload keeps its grasp.

    Args:
        options: options from the YAML.
        ctx: its `joints` are those of the servos, in the order of the vectors.

    Raises:
        CalibrationError: if the calibration is missing or lacks a joint.
    """

    def __init__(self, options: FollowerOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        self._ctx = ctx
        order = ctx.robot.indices(ctx.joints)
        lower = dict(zip(ctx.joints, ctx.robot.lower[order], strict=True))
        for fault in options.check(ctx.robot, ctx.joints):
            raise HardwareError(f"{ctx.name}: {fault.option[0]}: {fault.message}")
        try:
            calibration = load_calibration(options.calibration, ctx.joints, tool=TOOL, device=options.port)
        except IbrobotError as error:
            if is_device(options.port) or calibration_path(options.calibration).exists():
                raise
            known = "its emulator has no calibration" if Path(options.port).exists() else "there is no such port"
            raise self._not_emulated(known) from error
        closed = {joint: float(lower[joint]) for joint in options.anchored if joint in lower}
        self._arm = Arm(ctx.joints, calibration, closed)
        self._bus = FeetechBus(
            options.port, baud_rate=options.baud_rate, joints=self._arm.names, retries=options.retries
        )
        size = len(ctx.joints)
        self.signals = tuple(
            Signal(f"/{ctx.name}/{name}", size, f"of each servo [{unit}]")
            for name, unit in (("temperature", "deg C"), ("voltage", "V"), ("current", "A"), ("load", "of full torque"))
        )
        self._values = [nan_vector(size) for _ in self.signals]
        self._health = Health(options, ctx.joints, self._place)
        self._load = SteadyLoad(size, ns(options.health_period))
        self._lost = np.zeros(size, dtype=np.intp)
        self._health_due_ns = 0
        self._speed: Vector = np.zeros(size)
        self._velocity: Vector = np.zeros(size)
        self._counts = {"lost_replies": 0, "implausible_positions": 0}
        self._again_s = _AGAIN * seconds(ctx.period_ns)
        self._fault: HardwareError | None = HardwareError(f"{ctx.name}: not connected")
        self._relaxed = self._holding = False
        self._resetting = False
        """Whether the last reset failed, which may have left servos without torque."""
        self._limits = ctx.robot.lower[order], ctx.robot.upper[order]

    def _not_emulated(self, known: str) -> HardwareError:
        """The error of an emulated arm whose emulator does not run."""
        command = emulate(self._options.port, self._options.calibration, self._ctx.source)
        return HardwareError(f"{self._options.port}: {known}; for an emulated arm run {command}")

    @override
    def connect(self) -> None:
        bus, arm = self._bus, self._arm
        self._fault = HardwareError(f"{self._ctx.name}: not connected")
        try:
            open_port(bus, arm.calibration)
        except PortError as error:
            if is_device(bus.port.path) or Path(bus.port.path).exists():
                raise
            raise self._not_emulated("there is no such port") from error
        bus.return_delay_s = RETURN_DELAY_S
        self._relaxed = False
        try:
            check_adapter(arm.calibration, self._options.port)
            servos.find_servos(bus, arm)
            self._check_calibration()
            self._set_up(arm.servos)
            self._start()
            self._health.begin([supply(bus, servo) for servo in arm.servos])
        except BaseException:
            self._undo()
            bus.close()
            raise
        self._ctx.log.info("%s: %s", self._ctx.name, arm.zero_text)
        self._warn_of_ranges()

    @override
    def read(self) -> JointReading:
        if self._fault is not None:
            raise self._fault
        begun_ns = self._ctx.clock.now_ns()
        reader = self._health_reader if begun_ns >= self._health_due_ns else self._reader
        try:
            replies = reader.read(time.monotonic() + self._again_s)
            stamp_ns = (begun_ns + self._ctx.clock.now_ns()) // 2
            values = replies.values
            motion = values[:, reader.registers.index("present_position") :]
            good = replies.answered & self._plausible(motion[:, 0], replies.answered, stamp_ns)
            self._check_lost(replies, good)
        except FeetechError as error:
            self._fault = error
            raise
        self._health.report(replies.errors, replies.answered)
        self._take(motion, good, stamp_ns)
        if reader is self._health_reader:
            pause_s = self._take_health(values, begun_ns) if good.all() else _HEALTH_AGAIN_S
            self._health_due_ns = begun_ns + ns(pause_s)
        stale = bool(self._lost.any())
        position = self._arm.radians(self._ticks.astype(np.float64))
        return JointReading(stamp_ns, position, self._velocity.copy(), self._effort(), stale)

    @override
    def write(self, position: Vector) -> None:
        if np.shape(position) != (len(self.joints),) or not np.isfinite(position).all():
            raise HardwareError(f"{self._ctx.name}: expected {len(self.joints)} finite positions, got {position}")
        if not self._bus.is_open:
            raise HardwareError(f"{self._ctx.name}: not connected")
        if self._relaxed:
            self._holding = True
            for servo in self._arm.servos:
                servos.hold(self._bus, servo)
            self._relaxed = False
        self._writer.write(self._arm.ticks(position))

    @override
    def relax(self) -> Torque:
        try:
            servos.relax(self._bus, self._arm.servos)
        except TorqueStaysOn:
            raise
        except FeetechError as error:
            self._relaxed = True
            self._ctx.log.warning("cannot confirm that the torque is off: %s", error)
            return Torque.UNKNOWN
        self._relaxed, self._holding = True, False
        return Torque.OFF

    @override
    def holding(self) -> Holding | None:
        if not self._holding:
            return None
        port, ids = self._options.port, self._arm.servos
        others = "" if sorted(ids) == [*range(1, 7)] else "".join(f" --id {servo}" for servo in ids)
        return Holding(port, f"ibrobot feetech torque off {shlex.quote(port)}{others}")

    @override
    def health(self) -> Sequence[Condition]:
        return self._health.conditions

    @override
    def reset_faults(self) -> None:
        fault = self._fault
        if fault is None and not self._health.faulty and not self._resetting:
            return
        self._resetting = True
        bus, arm = self._bus, self._arm
        if isinstance(fault, PortError) or not bus.is_open:
            bus.close()
            open_port(bus, arm.calibration)
            check_adapter(arm.calibration, self._options.port)
        bus.return_delay_s = RETURN_DELAY_S
        bus.resynchronise()
        servos.find_servos(bus, arm)
        # A servo that kept its settings and torque continues to hold its joint.
        self._set_up([servo for servo in arm.servos if self._is_troubled(servo)])
        self._start()
        self._health.reset()
        self._resetting = False

    @override
    def disconnect(self) -> None:
        self._fault = HardwareError(f"{self._ctx.name}: not connected")
        self._bus.close()

    @override
    def counters(self) -> Mapping[str, int]:
        return {**self._bus.counters, **self._counts}

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        out[:] = self._values[index]

    def _set_up(self, ids: Sequence[int]) -> None:
        """Configure servos, and hold their present positions unless the arm is relaxed."""
        for servo in ids:
            self._holding = self._holding or not self._relaxed
            servos.set_up(self._bus, self._arm, self._tuning(), servo, torque=not self._relaxed)

    def _undo(self) -> None:
        """Switch the torque off after a failed start; servos that do not confirm it count as holding."""
        if self._holding:
            with suppress(TorqueStaysOn):
                self.relax()

    def _is_troubled(self, servo: int) -> bool:
        """Whether a servo has lost its settings or torque, or has an error that switching the torque off and on clears.

        Raises:
            ServoFault: if the error would persist, e.g. overheating; the torque is not changed.
        """
        code = self._bus.read_faulty(servo, "status")
        if lasting := code & ~(OVERLOAD | OVER_CURRENT):
            raise ServoFault(self._bus.place(servo, "status"), faults(lasting))
        if code == OVERLOAD and self._arm.names[servo] in self._options.gentle:
            code = 0
        return bool(code) or self._bus.read_faulty(servo, "torque_enable") != 1

    def _start(self) -> None:
        """Start reading from the joints' present positions, which every servo must report."""
        bus, ids = self._bus, self._arm.servos
        bus.return_delay_s = 0.0
        self._reader = SyncReader(bus, ids, "present_position", "present_load")
        self._health_reader = SyncReader(bus, ids, "torque_enable", "present_current")
        self._writer = SyncWriter(bus, ids)
        self._ticks = np.array(list(bus.sync_read("present_position", ids, faulty=True).values()), dtype=np.intp)
        self._doubtful = self._ticks
        self._ticks_ns = self._doubtful_ns = np.full(len(ids), self._ctx.clock.now_ns())
        self._speed = np.zeros(len(ids))
        self._velocity = np.zeros(len(ids))
        self._lost[:] = 0
        self._load.begin(self._ctx.clock.now_ns())
        self._health_due_ns = 0
        self._fault = None

    def _plausible(self, ticks: NDArray[np.intp], answered: NDArray[np.bool_], stamp_ns: int) -> NDArray[np.bool_]:
        """Whether the reported positions are plausible; with its 8 bits, the checksum does not detect all damage.

        A position that the joint's speed since its last valid reply cannot explain is accepted if the next reply
        confirms it.
        """
        elapsed_s = (stamp_ns - self._ticks_ns) * 1e-9
        near = np.abs(ticks - self._ticks - self._speed * elapsed_s) <= _reach(elapsed_s)
        again = np.abs(ticks - self._doubtful) <= _reach((stamp_ns - self._doubtful_ns) * 1e-9)
        inside = (ticks >= 0) & (ticks < 4096)
        good: NDArray[np.bool_] = inside & (near | again)
        self._counts["implausible_positions"] += int((answered & ~good).sum())
        self._doubtful = np.where(answered & inside, ticks, self._doubtful)
        self._doubtful_ns = np.where(answered & inside, stamp_ns, self._doubtful_ns)
        return good

    def _check_lost(self, replies: Replies, good: NDArray[np.bool_]) -> None:
        """Raise an error if valid replies are missing for too long."""
        self._lost = np.where(good, 0, self._lost + 1)
        self._counts["lost_replies"] += int((~replies.answered).sum())
        if (self._lost > self._options.lost_replies).any():
            gone = [self._arm.servos[i] for i in np.flatnonzero(self._lost > self._options.lost_replies)]
            ticks = self._options.lost_replies + 1
            others = f", nor from {', '.join(self._arm.names[servo] for servo in gone[1:])}" if len(gone) > 1 else ""
            raise NoReply(self._bus.place(gone[0], "present_position"), f"no valid reply for {ticks} ticks{others}")

    def _take(self, values: NDArray[np.intp], good: NDArray[np.bool_], stamp_ns: int) -> None:
        position, velocity, load = values[:, 0], values[:, 1], values[:, 2]
        self._ticks = np.where(good, position, self._ticks)
        self._ticks_ns = np.where(good, stamp_ns, self._ticks_ns)
        self._speed = np.where(good, velocity, self._speed)
        self._velocity = self._speed * self._arm.sign / TICKS_PER_RADIAN
        self._values[3] = np.where(good, load * self._arm.sign * _LOAD, self._values[3])
        self._load.add(self._values[3], good)

    def _take_health(self, values: NDArray[np.intp], now_ns: int) -> float:
        """Process a complete health reading; returns the time until the next one [s]."""
        columns = dict(zip(self._health_reader.registers, values.T.astype(np.float64), strict=True))
        self._values[0] = columns["present_temperature"]
        self._values[1] = columns["present_voltage"] * _VOLTAGE_V
        self._values[2] = columns["present_current"] * _CURRENT_A
        torque = None if self._relaxed else columns["torque_enable"] == 1
        measured = Measured(self._values[0], self._values[1], self._load.held(now_ns), torque)
        return 0.0 if self._health.measure(measured) else self._options.health_period

    def _effort(self) -> Vector:
        if self._options.stall_torque is None:
            return nan_vector(len(self.joints))
        return self._values[3] * self._options.stall_torque

    def _place(self, index: int) -> Place:
        return self._bus.place(self._arm.servos[index])

    def _check_calibration(self) -> None:
        differences = servos.calibration_differences(self._bus, self._arm)
        if not differences:
            return
        if self._options.write_calibration:
            servos.write_calibration(self._bus, self._arm, sorted({servo for servo, *_ in differences}))
            return
        servo, name, has, wanted = differences[0]
        more = f", and {len(differences) - 1} more differ" if len(differences) > 1 else ""
        raise HardwareError(
            f"{self._bus.place(servo, name)}: the servo has {has}, {self._arm.calibration.path} says {wanted}{more}; "
            "`ibrobot feetech check` shows all, `write_calibration: true` writes the file's to the servos"
        )

    def _tuning(self) -> Tuning:
        options = self._options
        every = {
            "return_delay": 0,
            "operating_mode": 0,
            "p_coefficient": options.p_coefficient,
            "i_coefficient": options.i_coefficient,
            "d_coefficient": options.d_coefficient,
            "maximum_acceleration": 254,
            "acceleration": options.acceleration,
        }
        # The same values protect the gripper's motor in LeRobot.
        gentle = {"max_torque": 500, "protection_current": 250, "overload_torque": 25}
        return Tuning(every, dict.fromkeys(options.gentle, gentle))

    def _warn_of_ranges(self) -> None:
        """Warn if the calibration is odd, or a range ends before the YAML's limit, where the servo stops."""
        limits = dict(zip(self.joints, zip(*(each.tolist() for each in self._limits), strict=True), strict=True))
        for odd in self._arm.oddities(limits):
            self._ctx.log.warning("%s: %s", self._arm.calibration.path, odd)
        for joint, low, high, lower, upper in zip(self.joints, *self._arm.reach(), *self._limits, strict=True):
            if lower < low - 0.1 or upper > high + 0.1:
                self._ctx.log.warning(
                    "%s: its calibrated range is %.2f to %.2f rad, its limits are %.2f to %.2f: it stops at the range",
                    joint,
                    low,
                    high,
                    lower,
                    upper,
                )


def _reach(elapsed_s: Vector) -> Vector:
    """Maximum distance of a joint from its expected position after that time [ticks]."""
    reach: Vector = _SLACK_TICKS + np.minimum(_MAX_ACCELERATION * elapsed_s, _MAX_SPEED) * elapsed_s
    return reach
