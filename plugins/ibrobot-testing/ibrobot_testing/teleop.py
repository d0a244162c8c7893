"""The conformance suite of teleoperation devices."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import ClassVar, get_args

import numpy as np
import pytest

from ibrobot_core.api import Context, JointReading, OperatorEvent, Teleop, TeleopCommand, TeleopError, Vector, ns
from ibrobot_testing.suite import Suite


class TeleopSuite(Suite[Teleop]):
    """Checks of every `Teleop`. The subclass plays the operator with `engage`, `release`, `operate` and `press`.

    The checks drive the device as a run does, with `begin_operation` and `operate`.
    """

    has_deadman: ClassVar[bool] = True
    """Whether the device has a deadman, which `release` releases."""
    has_operator: ClassVar[bool] = True
    """Whether an operator starts every motion. False for a device with `operated = False`."""
    tolerance_rad: ClassVar[float] = 1e-6
    """Allowed distance of the first positions from the measured ones [rad]."""

    step_rad: ClassVar[float] = 0.02
    """Allowed distance of the first positions after a new press from the measured ones [rad]: one step."""

    events: ClassVar[tuple[OperatorEvent, ...]] = ()
    """The events for which the device has buttons, which `press` presses."""

    def press(self, teleop: Teleop, event: OperatorEvent) -> None:
        """The operator presses the button of an event, and releases it."""
        raise NotImplementedError(f"{type(self).__name__} must define press for its events")

    def engage(self, teleop: Teleop) -> None:
        """The operator presses the deadman or starts motion; does nothing for a device that moves by itself."""

    def release(self, teleop: Teleop) -> None:
        """The operator releases the deadman."""
        raise NotImplementedError(f"{type(self).__name__} must define release, or set has_deadman = False")

    def operate(self, teleop: Teleop) -> None:
        """The operator, with the deadman pressed, commands motion."""
        raise NotImplementedError(f"{type(self).__name__} must define operate(self, teleop)")

    def hold(self, teleop: Teleop) -> None:
        """One period in which the operator keeps the deadman pressed and commands motion, and the device reports it.

        Calls `operate`; override it where that begins a new press.
        """
        self.operate(teleop)

    def rest(self, teleop: Teleop) -> None:
        """One period in which the deadman is released, and the device reports it; calls `release` by default."""
        if self.has_deadman:
            self.release(teleop)

    def freeze(self, teleop: Teleop) -> None:
        """The device goes silent, e.g. out of range, until the next `hold`, `release` or `engage`.

        Does nothing for devices that report only when these are called.
        """

    def connected(self, *, again: bool = False) -> AbstractContextManager[tuple[Teleop, Context]]:
        """A connected device with its context; for `again` see `in_use`."""
        return self.in_use(lambda teleop: teleop.connect(), lambda teleop: teleop.disconnect(), again=again)

    def poses(self, ctx: Context) -> list[Vector]:
        """Initial measured positions of the checks [rad], each shape (J,): nonzero and within limits."""
        lower, upper = ctx.robot.lower, ctx.robot.upper
        return [lower + share * (upper - lower) for share in (0.3, 0.6)]

    def _measure(self, ctx: Context, position: Vector) -> JointReading:
        ctx.clock.sleep_until(ctx.clock.now_ns() + ctx.period_ns)
        return JointReading(ctx.clock.now_ns(), position.copy(), np.zeros_like(position), np.zeros_like(position))

    def _begin(self, teleop: Teleop, ctx: Context, position: Vector) -> TeleopCommand:
        teleop.begin_operation(self._measure(ctx, position))
        return self._press(teleop, ctx, position)

    def _press(self, teleop: Teleop, ctx: Context, position: Vector) -> TeleopCommand:
        if self.has_operator:
            self.rest(teleop)
            teleop.operate(self._measure(ctx, position))
        self.engage(teleop)
        return teleop.operate(self._measure(ctx, position))

    def test_begins_where_the_robot_is(self) -> None:
        """The first positions after each `activate` are the measured ones."""
        with self.connected() as (teleop, ctx):
            for pose in self.poses(ctx):
                command = self._begin(teleop, ctx, pose)
                assert command.positions, "no positions with the deadman pressed"
                _check_near(command, ctx, pose, self.tolerance_rad)

    def test_positions_are_of_known_joints(self) -> None:
        """Every position is finite and belongs to a joint of the robot."""
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            commands = [self._begin(teleop, ctx, pose)]
            self.operate(teleop)
            commands += [teleop.operate(self._measure(ctx, pose)) for _ in range(10)]
            for command in commands:
                for joint, position in (command.positions or {}).items():
                    assert joint in ctx.robot.joint_names, f"{joint!r} is not a joint of this robot"
                    assert np.isfinite(position)

    def test_operating_moves(self) -> None:
        """After the operator commands motion, positions change within a second."""
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            first = self._begin(teleop, ctx, pose).positions or {}
            self.operate(teleop)
            for _ in range(100):
                positions = teleop.operate(self._measure(ctx, pose)).positions or {}
                if any(abs(positions[j] - first.get(j, positions[j])) > self.tolerance_rad for j in positions):
                    return
            pytest.fail("the operator asked for motion and none came")

    def test_released_deadman_gives_none(self) -> None:
        """While the deadman is released, positions are None, both before and after it was pressed."""
        if not self.has_deadman:
            pytest.skip("has no deadman")
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            teleop.begin_operation(self._measure(ctx, pose))
            assert teleop.operate(self._measure(ctx, pose)).positions is None
            assert self._press(teleop, ctx, pose).positions is not None
            self.release(teleop)
            commands = [teleop.operate(self._measure(ctx, pose)) for _ in range(2)]
            assert commands[-1].positions is None

    def test_waits_for_the_operator(self) -> None:
        """After each `activate` (launch, mode switch, reset), nothing moves before the operator acts again."""
        if not self.has_operator:
            pytest.skip("moves by itself")
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            for _ in range(2):
                teleop.begin_operation(self._measure(ctx, pose))
                for _ in range(100):
                    positions = teleop.operate(self._measure(ctx, pose)).positions
                    assert positions is None, "it commands positions before the operator has acted"
                self._press(teleop, ctx, pose)
                self.operate(teleop)
                assert teleop.operate(self._measure(ctx, pose)).positions, "no positions once the operator acted"

    @contextmanager
    def _moving(self) -> Iterator[tuple[Teleop, Context, Vector]]:
        """A connected device that moves a robot by its deadman, with the robot's pose."""
        if not (self.has_deadman and self.has_operator):
            pytest.skip("has no deadman")
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            self._begin(teleop, ctx, pose)
            for _ in range(5):
                self.hold(teleop)
                assert teleop.operate(self._measure(ctx, pose)).positions, "no positions with the deadman pressed"
            yield teleop, ctx, pose

    def _needs_a_new_press(self, teleop: Teleop, ctx: Context, pose: Vector) -> None:
        """Check that the held deadman moves nothing, and a new press does."""
        for _ in range(100):
            self.hold(teleop)
            positions = teleop.operate(self._measure(ctx, pose)).positions
            assert positions is None, "it moves again by the same press of the deadman"
        command = self._press(teleop, ctx, pose)
        assert command.positions, "a new press moves nothing"
        _check_near(command, ctx, pose, self.step_rad)

    def test_a_held_deadman_does_not_survive_an_activation(self) -> None:
        """A deadman held over a stop, a reset, a mode switch or a change of control must be pressed again."""
        with self._moving() as (teleop, ctx, pose):
            teleop.begin_operation(self._measure(ctx, pose))
            self._needs_a_new_press(teleop, ctx, pose)

    def test_silence_ends_motion(self) -> None:
        """Without reports motion ends within `hold_s`, and needs a new press of the deadman when they come again."""
        with self._moving() as (teleop, ctx, pose):
            begun_ns = ctx.clock.now_ns()
            self.freeze(teleop)
            try:
                while teleop.operate(self._measure(ctx, pose)).positions is not None:
                    assert ctx.clock.now_ns() - begun_ns <= ns(teleop.deadman.hold_s), "a silent device moves the robot"
                for _ in range(20):
                    assert teleop.operate(self._measure(ctx, pose)).positions is None, "it moves again by itself"
            except TeleopError:
                return  # a fault, until a reset activates it
            self._needs_a_new_press(teleop, ctx, pose)

    def test_a_pause_of_the_host_ends_motion(self) -> None:
        """After two seconds in which nobody read the device, it needs a new press of the deadman."""
        with self._moving() as (teleop, ctx, pose):
            self.hold(teleop)
            ctx.clock.sleep_until(ctx.clock.now_ns() + ns(2.0))
            try:
                assert teleop.operate(self._measure(ctx, pose)).positions is None, "it goes on after a pause"
            except TeleopError:
                return
            self._needs_a_new_press(teleop, ctx, pose)

    def test_each_press_is_one_event(self) -> None:
        """Each press of a button gives its event once, even while the deadman is released, and none before."""
        if not self.events:
            pytest.skip("has no buttons")
        unknown = [event for event in self.events if event not in get_args(OperatorEvent)]
        assert not unknown, f"no event of an operator: {unknown}; there are {', '.join(get_args(OperatorEvent))}"
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            teleop.begin_operation(self._measure(ctx, pose))
            assert list(teleop.operate(self._measure(ctx, pose)).events) == [], "an event before any button"
            for event in (*self.events, *self.events):
                self.press(teleop, event)
                events = [each for _ in range(3) for each in teleop.operate(self._measure(ctx, pose)).events]
                assert events == [event]

    def test_approach_arrives(self) -> None:
        """`approach` returns True within ten seconds of ticks; then the device begins where the robot is."""
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[1]
            assert any(teleop.approach(self._measure(ctx, pose)) for _ in range(1000)), "it never arrives"
            _check_near(self._begin(teleop, ctx, pose), ctx, pose, self.tolerance_rad)

    def test_leaves_the_measurement_alone(self) -> None:
        """`activate` and `read` do not change `measured`, and later changes of it do not affect the device."""
        with self.connected() as (teleop, ctx):
            pose = self.poses(ctx)[0]
            begin = self._measure(ctx, pose)
            teleop.begin_operation(begin)
            np.testing.assert_array_equal(begin.position, pose)
            begin.position[:] = 0.0
            self.rest(teleop)
            if self.has_operator:
                before = self._measure(ctx, pose)
                teleop.operate(before)
                before.position[:] = 0.0
            self.engage(teleop)
            now = self._measure(ctx, pose)
            command = teleop.operate(now)
            np.testing.assert_array_equal(now.position, pose)
            _check_near(command, ctx, pose, self.tolerance_rad)

    def test_disconnect_is_safe_at_any_time(self) -> None:
        """`disconnect` may be called before `connect` and twice; `connect` works again afterwards."""
        with self.connected(again=True) as (teleop, ctx):
            assert isinstance(self._begin(teleop, ctx, self.poses(ctx)[0]), TeleopCommand)

    def test_refuses_reading_while_disconnected(self) -> None:
        """`read` raises TeleopError before `connect`, and after `disconnect`."""
        ctx = self.context()
        with pytest.raises(TeleopError):
            self.make(ctx).operate(self._measure(ctx, self.poses(ctx)[0]))
        with self.connected() as (teleop, ctx):
            pass
        with pytest.raises(TeleopError):
            teleop.operate(self._measure(ctx, self.poses(ctx)[0]))


def _check_near(command: TeleopCommand, ctx: Context, pose: Vector, most_rad: float) -> None:
    """Check that no position is farther than `most_rad` [rad] from that of a pose [rad], shape (J,)."""
    for joint, position in (command.positions or {}).items():
        measured = pose[ctx.robot.joint_names.index(joint)]
        assert abs(position - measured) <= most_rad, f"{joint} jumps from {measured} to {position}"
