"""Hardware `lerobot`: a robot of LeRobot's, in a process of its own."""

from __future__ import annotations

import json
import shlex
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any, override

import numpy as np

from ibrobot_core.api import (
    Condition,
    Context,
    Hardware,
    HardwareError,
    Holding,
    JointReading,
    NotSupported,
    Severity,
    Torque,
    Vector,
    nan_vector,
    ns,
    seconds,
)
from ibrobot_lerobot_devices.base import Base
from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem, age_ns
from ibrobot_lerobot_devices.options import RobotOptions
from ibrobot_lerobot_devices.standing import MAY_DRIVE, Standing
from ibrobot_lerobot_devices.units import (
    EFFORT,
    POSITION,
    VELOCITY,
    UnitProblem,
    bases,
    columns,
    driven,
    map_axes,
    map_joints,
)

_WAIT = 0.4
"""Fraction of a tick for which a reading is waited for; a later one counts in the next tick."""
_RELAX_S = 0.5
"""How long switching the torque may take [s]."""
_RECONNECT_S = 1.0
"""How long a reset waits for the device to connect again [s]."""
_AGAIN = "LeRobot starts again, which takes some seconds: reset once more"
_SPAN = 4
"""Readings from which a velocity is computed if LeRobot gives none."""


class LeRobotHardware(Hardware):
    """A robot of LeRobot's. Its calls block in its own process; a tick waits for a part of a period at most.

    A reading has the time at which it was made. One that comes too late for its tick counts in the next, and until
    then readings are stale; after `blocked` seconds without one it is a fault that names the call. Meanwhile LeRobot's
    robots keep their last goal.

    A base stands without a measurement for `blocked` seconds, and at every fault.

    Args:
        options: options from the YAML.
        ctx: its `joints` are those of the robot, in the order of the vectors.
    """

    def __init__(self, options: RobotOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        self._ctx = ctx
        self._wait_s = _WAIT * seconds(ctx.period_ns)
        self._link = DeviceLink("robot", options.robot, options.config, torch=options.torch)
        self._fault: HardwareError | None = self._error("is not connected")
        self._starting = False
        self._newest: JointReading | None = None
        self._lost = 0
        self._base = Base((), {}, (), np.zeros(0), np.zeros(0), seconds(ctx.period_ns))
        self._measured_ns = 0
        """When the newest reading came [ns]."""
        self._standing: Standing | None = None
        """Makes the base stand after a fault; None without one."""
        self._on = False
        self._has_torque = False
        self._relaxed = False
        self._counts = {"lost_readings": 0, "late_readings": 0}

    @override
    def connect(self) -> None:
        self._fault, self._relaxed = self._error("is not connected"), False
        try:
            self._take(self._link.start(self._options.start_timeout))
        except (DeviceProblem, UnitProblem) as problem:
            self.disconnect()
            raise self._error(problem) from None

    @override
    def read(self) -> JointReading:
        if self._fault is not None:
            if self._standing is not None:
                self._standing.step()
            raise self._fault
        try:
            answer = self._link.read(self._wait_s)
        except DeviceProblem as problem:
            raise self._fail(problem) from None
        self._counts["late_readings"] = self._link.late
        times, why = self._link.refused
        if self._base.features and times > self._options.lost_readings:
            raise self._fail(f"LeRobot does not carry actions out: {why}")
        if answer is not None:
            wrong = answer.get("error") or self._wrong(answer["values"])
            if not wrong:
                self._lost = 0
                self._measured_ns = self._ctx.clock.now_ns()
                self._newest = self._reading(answer)
                return self._newest
            self._lost += 1
            self._counts["lost_readings"] += 1
            if self._lost > self._options.lost_readings:
                raise self._fail(wrong)
        if self._link.blocked_s > self._options.blocked:
            raise self._fail(self._link.blockage("get_observation"))
        newest = self._newest
        if newest is None:
            now_ns, size = self._ctx.clock.now_ns(), len(self.joints)
            return JointReading(now_ns, np.zeros(size), np.zeros(size), nan_vector(size), stale=True)
        return JointReading(
            newest.stamp_ns, newest.position.copy(), newest.velocity.copy(), newest.effort.copy(), stale=True
        )

    @override
    def write(self, position: Vector) -> None:
        if np.shape(position) != (len(self.joints),) or not np.isfinite(position).all():
            raise self._error(f"expected {len(self.joints)} finite positions, got {position}")
        if self._link.pid is None or self._starting or (self._standing is not None and self._standing.is_starting):
            raise self._fault or self._error("is not connected")
        try:
            if self._relaxed:
                self._link.call("hold", _RELAX_S)
                self._relaxed, self._on = False, True
                self._base.forget()
            values = (position[self._turned] - self._offset) / self._factor
            unmeasured = self._ctx.clock.now_ns() - self._measured_ns > ns(self._options.blocked)
            stands = self._fault is not None or unmeasured
            driven_at = self._base.stand() if stands else self._base.drive(position[self._rolled])
            self._link.act({**self._rest, **driven_at, **dict(zip(self._features, values.tolist(), strict=True))})
        except DeviceProblem as problem:
            raise self._fail(problem) from None

    @override
    def relax(self) -> Torque:
        if self._link.pid is not None and not self._has_torque:
            raise NotSupported(f"LeRobot's {self._options.robot} has no call that switches the torque off")
        self._relaxed = True
        try:
            self._link.call("relax", _RELAX_S)
        except DeviceProblem as problem:
            self._ctx.log.warning("%s: cannot confirm that the torque is off: %s", self._ctx.name, problem)
            return Torque.UNKNOWN
        self._on = False
        return Torque.OFF

    @override
    def holding(self) -> Holding | None:
        if not self._on:
            return None
        options = self._options
        config = json.dumps(options.config)
        where = str(options.config.get("port", options.robot))
        return Holding(where, f"ibrobot lerobot torque-off {options.robot} --config {shlex.quote(config)}")

    @override
    def health(self) -> Sequence[Condition]:
        standing = self._standing
        if standing is None or not standing.is_in_doubt:
            return ()
        joint = self.joints[self._rolled[0]]
        message = f"{self._ctx.name}: {MAY_DRIVE}; LeRobot has not confirmed that it stands"
        return (Condition(joint, "velocity", float("nan"), "m/s", Severity.FAULT, message),)

    @override
    def reset_faults(self) -> None:
        self._base.forget()  # the command begins again where the base is
        if self._fault is None:
            return
        link, standing = self._link, self._standing
        try:
            if standing is not None and (link.pid is None or standing.is_starting or standing.found is not None):
                if (answer := standing.restart(_RECONNECT_S)) is None:
                    raise self._fail(_AGAIN)
                self._take(answer, again=True)
                return
            if not self._starting and link.pid is not None:
                link.read(self._wait_s)  # the call may have returned meanwhile
            if not self._starting and link.pid is not None and link.blocked_s <= self._options.blocked:
                self._take(link.call("reconnect", _RECONNECT_S), again=True)
                return
            if not self._starting:
                link.begin()
                self._starting = True
            if (answer := link.poll_start(_RECONNECT_S)) is None:
                raise self._fail(_AGAIN)
            self._take(answer, again=True)
        except (DeviceProblem, UnitProblem) as problem:
            self._starting = False
            raise self._fail(problem) from None

    @override
    def disconnect(self) -> None:
        if self._link.pid is not None and self._fault is None:
            self._ctx.log.info("%s: LeRobot reports no torque, temperature or voltage of its motors", self._ctx.name)
        self._fault, self._starting, self._standing = self._error("is not connected"), False, None
        if not self._link.end() and self._base.features:
            self._ctx.log.error("%s: %s", self._ctx.name, MAY_DRIVE)

    @override
    def counters(self) -> Mapping[str, int]:
        return self._counts

    def _take(self, answer: Mapping[str, Any], *, again: bool = False) -> None:
        """Take in what the connected device says about itself.

        Raises:
            UnitProblem: if its joints are not those of the robot.
        """
        robot, order = self._ctx.robot, self._ctx.robot.indices(self.joints)
        limits = dict(zip(self.joints, zip(robot.lower[order], robot.upper[order], strict=True), strict=True))
        actions, choices = answer["action_features"], self._options.choices()
        axes = map_axes(actions, answer["motors"], choices, self.joints)
        rolled = [each.joint for each in axes]
        turned = [joint for joint in self.joints if joint not in rolled]
        mapped = map_joints(actions, answer["motors"], choices, turned, limits)
        self._factor, self._offset = columns(mapped)
        self._turned = [self.joints.index(joint) for joint in turned]
        self._rolled = [self.joints.index(joint) for joint in rolled]
        at, period_s = robot.indices(rolled), seconds(self._ctx.period_ns)
        highest = robot.max_velocity[at], robot.max_acceleration[at]
        base = Base(axes, driven(actions), answer["observation_features"], *highest, period_s)
        if again:
            base.way = self._base.way
        self._base = base
        named = {end: bases(answer["observation_features"], end) for end in (POSITION, VELOCITY, EFFORT)}
        bare = [each.feature for each in mapped]
        self._features = [bases(actions, POSITION)[base] for base in bare]
        self._columns = [[named[end].get(base) for base in bare] for end in (POSITION, VELOCITY, EFFORT)]
        # A base without joints in the robot YAML stands; other joints that it lacks stay where they are.
        self._rest = {name: 0.0 for name in driven(actions).values() if name not in self._base.features}
        self._unmapped = [name for name in bases(actions, POSITION).values() if name not in self._features]
        self._history: deque[tuple[int, Vector]] = deque(maxlen=_SPAN)
        self._newest, self._lost = None, 0
        self._has_torque = answer["torque"]
        self._starting = False
        self._on = self._has_torque
        if again and self._relaxed:  # LeRobot has switched the torque on
            self._link.call("relax", _RELAX_S)
            self._on = False
        self._fault = self._standing = None
        if self._base.features:
            self._link.prepare()
        if not again:
            self._say(answer)

    def _say(self, answer: Mapping[str, Any]) -> None:
        log, name = self._ctx.log, self._ctx.name
        if self._unmapped:
            log.warning("%s: %s of LeRobot's robot are no joints here, and stay", name, ", ".join(self._unmapped))
        if self._rest:
            axes = ", ".join(self._rest)
            log.warning("%s: %s are always 0: the base stands, unless its axes are joints of the robot", name, axes)
        if not answer["keeps_torque"]:
            log.warning("%s: LeRobot's %s may switch its torque off at the end", name, self._options.robot)

    def _wrong(self, values: Mapping[str, float]) -> str:
        """Why the values of a reading are no measurement; empty if they are one."""
        for name in self._columns[0]:
            if name is not None and not np.isfinite(values.get(name, np.nan)):
                return f"LeRobot gave no finite position of {self.joints[self._turned[self._columns[0].index(name)]]}"
        return self._base.wrong(values)

    def _reading(self, answer: Mapping[str, Any]) -> JointReading:
        values = answer["values"]
        position, velocity, effort = (
            np.array([np.nan if name is None else values.get(name, np.nan) for name in names])
            for names in self._columns
        )
        stamp_ns = self._ctx.clock.now_ns() - age_ns(answer)
        turned = self._factor * position + self._offset
        self._base.measure(values, stamp_ns)
        position = self._whole(turned, self._base.way)
        self._history.append((stamp_ns, position))
        measured = self._differences()
        velocity = self._whole(self._factor * velocity, self._base.velocity)
        velocity = np.where(np.isfinite(velocity), velocity, measured)
        effort = self._whole(effort, np.full(len(self._rolled), np.nan))
        return JointReading(stamp_ns, position, velocity, effort)

    def _whole(self, turned: Vector, rolled: Vector) -> Vector:
        """Values of all joints, shape (J,), from those of the arm and those of the base."""
        whole = np.empty(len(self.joints))
        whole[self._turned], whole[self._rolled] = turned, rolled
        return whole

    def _differences(self) -> Vector:
        """Velocity over the last readings [rad/s], shape (J,)."""
        (begun_ns, first), (ended_ns, last) = self._history[0], self._history[-1]
        if ended_ns <= begun_ns:
            return np.zeros_like(last)
        return (last - first) / seconds(ended_ns - begun_ns)

    def _error(self, text: object) -> HardwareError:
        return HardwareError(f"{self._ctx.name}: {text}")

    def _fail(self, text: object) -> HardwareError:
        if self._base.features and self._standing is None:
            self._standing = Standing(self._link, self._ctx.log)
            if self._base.drives:
                text = f"{text}; unless the log says that it stands, {MAY_DRIVE}"
        self._fault = self._error(text)
        return self._fault
