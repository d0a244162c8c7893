"""Teleop `so101_leader`: an arm moved by hand, that the robot follows, without torque except before a takeover."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import attrs
import numpy as np
from ibrobot_calibration import load_calibration
from ibrobot_terminal.hand_moved import HandMoved

from ibrobot_core.api import (
    Context,
    HardwareError,
    JointReading,
    Teleop,
    TeleopCommand,
    TeleopError,
    Vector,
    ns,
    seconds,
)
from ibrobot_feetech.arm import Arm, calibration_differences, find_servos, hold, relax
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.errors import FeetechError
from ibrobot_feetech.opening import open_port
from ibrobot_feetech.options import TOOL, LeaderOptions
from ibrobot_feetech.sync import SyncReader
from ibrobot_feetech.ticks import TICKS_PER_RADIAN, TICKS_PER_TURN
from ibrobot_feetech.usb import check_adapter

_LONGEST_STEP_S = 0.1
"""Longest time step of its motors' goal, e.g. after a pause of the host [s]."""
_FASTEST_HAND = 13_000
"""Upper bound on the speed of a joint moved by hand [ticks/s]: three turns per second."""
_SLACK = 64
"""Change of a position that is always accepted [ticks]."""
_ARRIVED = 30
"""Largest distance of a joint from the robot's pose at which its motor lets go [ticks]: 2.6 degrees."""
_PATIENCE_S = 2.0
"""How much longer than the way takes the motors try to reach the robot's pose [s]."""
_TAKEN_UP = 40
"""A joint that turned by more was moved by hand [ticks]: 3.5 degrees."""


class LeaderTeleop(Teleop):
    """Maps the leader's positions to the robot's joints; approaches them slowly at first, then follows directly.

    Joints are mapped by angle; those in `scaled` linearly from their calibrated range to the robot's limits.
    Arrays have one element for each mapped joint, shape (S,).
    """

    def __init__(self, options: LeaderOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        robot = ctx.robot
        pairs = options.pairs(robot)
        self._leader_joints = tuple(pairs)
        self._joints = tuple(pairs.values())
        self._check_names("joints", self._joints, robot.joint_names)
        calibration = load_calibration(options.calibration, self._leader_joints, tool=TOOL, device=options.port)
        for option, names in (("inverted", options.inverted), ("scaled", options.scaled)):
            self._check_names(option, names, tuple(calibration.joints))
        self._arm = Arm(self._leader_joints, calibration)
        joints = [calibration.joints[name] for name in self._leader_joints]
        self._range = np.array([joint.range_min for joint in joints]), np.array([joint.range_max for joint in joints])
        self._turned = np.array([joint.inverted for joint in joints])
        self._mirrored = np.array([name in options.inverted for name in self._leader_joints])
        self._scaled = np.array([name in options.scaled for name in self._leader_joints])
        columns = robot.indices(self._joints)
        self._columns = columns
        self._lower, self._upper = robot.lower[columns], robot.upper[columns]
        self._ramp = np.minimum(options.ramp_velocity, robot.max_velocity[columns])

        self._bus: FeetechBus | None = None
        self._reader: SyncReader | None = None
        self._hand = HandMoved(options, ctx, "leader arm", _TAKEN_UP)
        self._ticks = np.zeros(len(pairs), dtype=np.int32)
        """The last valid positions [ticks]."""
        self._ticks_ns = np.zeros(len(pairs), dtype=np.int64)
        """When they were read [ns]."""
        self._lost = np.zeros(len(pairs), dtype=np.int32)
        """Number of reads since then."""
        self._goal: Vector | None = None
        """The goal of its motors while they move it [ticks]."""
        self._driven_ns = 0
        """When the goal was computed [ns]."""
        self._give_up_ns = 0
        """When its motors give up, e.g. because a hand holds the leader [ns]."""

    @override
    def connect(self) -> None:
        self._hand.check()
        port, baud_rate, retries = self._options.port, self._options.baud_rate, self._options.retries
        bus = FeetechBus(port, baud_rate=baud_rate, joints=self._arm.names, retries=retries)
        try:
            open_port(bus, self._arm.calibration)
            check_adapter(self._arm.calibration, port)
            self._prepare(bus)
        except HardwareError as error:
            bus.close()
            raise TeleopError(f"{self._ctx.name}: {error}") from None
        self._ctx.log.info("%s: %s", self._ctx.name, self._arm.zero_text)
        limits = zip(self._lower.tolist(), self._upper.tolist(), strict=True)
        by_angle = {
            joint: ends
            for joint, ends, scaled in zip(self._leader_joints, limits, self._scaled.tolist(), strict=True)
            if not scaled
        }
        for odd in self._arm.oddities(by_angle):
            self._ctx.log.warning("%s: %s", self._arm.calibration.path, odd)
        self._bus, self._reader = bus, SyncReader(bus, self._arm.servos, "present_position")
        self._hand.connect()

    @override
    def approach(self, measured: JointReading) -> bool:
        if not self._options.driven:
            return True
        if self._bus is None or self._reader is None:
            raise TeleopError(f"{self._ctx.name}: the leader is not connected: call connect before approach")
        now_ns = measured.stamp_ns
        try:
            self._receive(self._reader, now_ns)
            pose = self._leader_pose(measured.position[list(self._columns)])
            if self._goal is None:
                for servo in self._arm.servos:
                    hold(self._bus, servo)
                self._goal, self._driven_ns = self._ticks.astype(np.float64), now_ns
                slowest_s = np.abs(pose - self._goal).max() / (self._ramp.min() * TICKS_PER_RADIAN)
                self._give_up_ns = now_ns + ns(_PATIENCE_S + float(slowest_s))
            elapsed_s = min(seconds(now_ns - self._driven_ns), _LONGEST_STEP_S)
            self._driven_ns = now_ns
            step = self._ramp * TICKS_PER_RADIAN * elapsed_s
            self._goal = self._goal + np.clip(pose - self._goal, -step, step)
            goals = np.rint(self._goal).astype(int).tolist()
            self._bus.sync_write("goal_position", dict(zip(self._arm.servos, goals, strict=True)))
            if np.abs(pose - self._ticks).max() > _ARRIVED and now_ns < self._give_up_ns:
                return False
            self._let_go()
        except HardwareError as error:
            raise TeleopError(f"{self._ctx.name}: {error}") from None
        return True

    @override
    def activate(self, measured: JointReading) -> None:
        if self._goal is not None:
            try:
                self._let_go()
            except HardwareError as error:
                self._ctx.log.error("%s: %s", self._ctx.name, error)
        self._hand.activate(measured.stamp_ns)

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if self._reader is None:
            raise TeleopError(f"{self._ctx.name}: the leader is not connected: call connect before read")
        now_ns = measured.stamp_ns
        self._hand.take(now_ns)
        self._receive(self._reader, now_ns)
        # A press counts with the oldest of the servos' positions.
        engaged = self._hand.engaged(self._ticks, complete=not self._lost.any())
        self.deadman.report(engaged, int(self._ticks_ns.min()))
        where = measured.position[list(self._columns)]
        return self._hand.command(self.deadman, self._joints, where, self._pose(), self._ramp, now_ns)

    @override
    def disconnect(self) -> None:
        bus = self._bus
        try:
            if self._goal is not None:
                self._let_go()
        except HardwareError as error:
            self._ctx.log.error("%s: %s", self._ctx.name, error)
        self._hand.disconnect()
        self._bus, self._reader, self._goal = None, None, None
        if bus is not None:
            bus.close()

    @override
    def help(self) -> str:
        return self._hand.help()

    def _check_names(self, option: str, names: Sequence[str], known: Sequence[str]) -> None:
        for name in names:
            if name not in known:
                raise TeleopError(f"{self._ctx.name}: {option}: no joint {name!r}; the joints are: {', '.join(known)}")

    def _prepare(self, bus: FeetechBus) -> None:
        """Switch the torque off and confirm it, remove the servos' answer delay, and check their calibration.

        Raises:
            HardwareError: e.g. if a servo does not answer; names it.
        """
        ids = self._arm.servos
        find_servos(bus, self._arm)
        relax(bus, ids)
        for servo, delay in bus.sync_read("return_delay", ids).items():
            if delay:
                bus.write(servo, "lock", 0)
                bus.write(servo, "return_delay", 0)
                bus.write(servo, "lock", 1)
        for servo, name, stored, wanted in calibration_differences(bus, self._arm):
            raise HardwareError(
                f"{bus.place(servo, name)}: the servo has {stored}, {self._arm.calibration.path} says {wanted}; "
                "`ibrobot feetech check` shows all differences, `ibrobot feetech calibrate` makes a new calibration"
            )
        ticks = bus.sync_read("present_position", ids)
        self._ticks[:] = [ticks[servo] for servo in ids]
        self._ticks_ns[:] = self._ctx.clock.now_ns()
        self._lost[:] = 0

    def _receive(self, reader: SyncReader, now_ns: int) -> None:
        """Store the received positions; missing or implausible ones keep their last values."""
        try:
            replies = reader.read()
        except FeetechError as error:
            raise TeleopError(f"{self._ctx.name}: {error}") from None
        # Error bits are ignored: without torque nothing can overheat, and the encoder is still correct.
        ticks = replies.values[:, 0]
        reach = _SLACK + _FASTEST_HAND * (now_ns - self._ticks_ns) * 1e-9
        good = replies.answered & (ticks >= 0) & (ticks < TICKS_PER_TURN) & (np.abs(ticks - self._ticks) <= reach)
        self._ticks[good] = ticks[good]
        self._ticks_ns[good] = now_ns
        self._lost = np.where(good, 0, self._lost + 1)
        worst = int(np.argmax(self._lost))
        if self._lost[worst] > self._options.lost_replies:
            self._give_up(worst, int(ticks[worst]) if replies.answered[worst] else None)

    def _give_up(self, joint: int, ticks: int | None) -> None:
        assert self._bus is not None
        what = (
            "no reply"
            if ticks is None
            else f"position {ticks} right after {self._ticks[joint]}, which no hand can do: "
            "it passed the encoder's end (0/4095), so calibrate again, or its answers are damaged"
        )
        place, times = self._bus.place(self._arm.servos[joint]), self._lost[joint]
        raise TeleopError(
            f"{self._ctx.name}: {place}: {what}, {times} times in a row; check its power and the cable to it"
        )

    def pose(self) -> dict[str, float]:
        """Joint of the robot -> where the connected leader stands [rad]; limits of the robot do not apply."""
        return dict(zip(self._joints, self._mapped().tolist(), strict=True))

    def _pose(self) -> Vector:
        """The leader's pose mapped to the robot's joints [rad], within their limits."""
        return np.clip(self._mapped(), self._lower, self._upper)

    def _mapped(self) -> Vector:
        """The leader's pose mapped to the robot's joints [rad]."""
        ticks = self._ticks.astype(np.float64)
        low, high = self._range
        angles = np.where(self._mirrored, -1.0, 1.0) * self._arm.radians(ticks)
        opened = np.clip((ticks - low) / (high - low), 0.0, 1.0)
        opened = np.where(self._turned != self._mirrored, 1.0 - opened, opened)
        positions: Vector = np.where(self._scaled, self._lower + opened * (self._upper - self._lower), angles)
        return positions

    def _leader_pose(self, positions: Vector) -> Vector:
        """Positions of the robot's joints [rad] mapped to the leader's [ticks], within their calibrated ranges."""
        low, high = self._range
        angles = self._arm.positions(np.where(self._mirrored, -1.0, 1.0) * positions).astype(np.float64)
        opened = (positions - self._lower) / (self._upper - self._lower)
        opened = low + np.where(self._turned != self._mirrored, 1.0 - opened, opened) * (high - low)
        pose: Vector = np.clip(np.where(self._scaled, opened, angles), low, high)
        return pose

    def _let_go(self) -> None:
        """Switch its torque off.

        Raises:
            HardwareError: if a servo does not confirm it.
        """
        assert self._bus is not None
        self._goal = None
        relax(self._bus, self._arm.servos)


def read_pose(options: LeaderOptions, ctx: Context) -> dict[str, float]:
    """Where a leader stands: joint of the robot -> position [rad]. Its torque is off afterwards.

    Raises:
        TeleopError: if it cannot be read.
    """
    leader = LeaderTeleop(attrs.evolve(options, deadman="none"), ctx)
    leader.connect()
    try:
        return leader.pose()
    finally:
        leader.disconnect()
