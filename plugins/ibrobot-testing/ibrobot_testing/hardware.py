"""The conformance suites of hardware, real and simulated."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import override

import numpy as np
import pytest

from ibrobot_core.api import (
    Context,
    EpisodeSetup,
    Hardware,
    HardwareError,
    JointReading,
    NotSupported,
    SimulatedHardware,
    SteppedClock,
    Torque,
    Vector,
    ns,
    seconds,
)
from ibrobot_testing.contexts import control_context
from ibrobot_testing.suite import Suite


class HardwareSuite(Suite[Hardware]):
    """Checks of every `Hardware`. A driver uses a fake of its bus."""

    settle_s = 1.0
    """Time within which every joint moves at least half-way to a nearby command [s]."""
    move_rad = 0.2
    """Distance by which the checks move a joint [rad]."""
    reach = 0.5
    """Share of each joint's range, around its middle, that the checks command."""
    tolerance_rad = 0.03
    """Allowed motion of a holding joint [rad]."""
    quantum_rad = 0.004
    """Motion between two ticks below which readings may be equal [rad]: a few steps of an encoder."""

    @override
    def context(self) -> Context:
        return control_context()

    def elapse(self, hardware: Hardware, ctx: Context, duration_s: float) -> None:
        """Let `duration_s` [s] pass; override it if a fake bus must be advanced."""
        for _ in range(max(1, round(ns(duration_s) / ctx.period_ns))):
            ctx.clock.sleep_until(ctx.clock.now_ns() + ctx.period_ns)
            if isinstance(hardware, SimulatedHardware):
                hardware.advance(ctx.period_ns)

    def has_torque(self, hardware: Hardware) -> bool:
        """Whether the device itself has torque: its fake or emulator knows. Override it to have torque checked."""
        pytest.skip("override has_torque to have this checked")

    def lose_replies(self, hardware: Hardware) -> None:
        """Make the device answer nothing from now on, while it stays plugged in. Override it to have this checked."""
        pytest.skip("override lose_replies to have this checked")

    def unplug(self, hardware: Hardware) -> None:
        """Take the device away, as if its cable was pulled. Override it to have this checked."""
        pytest.skip("override unplug to have this checked")

    def stall(self, hardware: Hardware, joint: int) -> None:
        """Block a joint, whatever it is commanded. Override it to have this checked."""
        pytest.skip("override stall to have this checked")

    def connected(self, *, again: bool = False) -> AbstractContextManager[tuple[Hardware, Context]]:
        """Connected hardware with its context; for `again` see `in_use`."""
        return self.in_use(lambda hardware: hardware.connect(), lambda hardware: hardware.disconnect(), again=again)

    def moved(self, hardware: Hardware, ctx: Context) -> Vector:
        """Move every joint towards the middle of its range and return the measured position [rad], shape (J,).

        Without this, hardware that always moves to zero would pass the checks of holding.
        """
        start = hardware.read().position.copy()
        goal = self._target(hardware, ctx)
        hardware.write(goal)
        self.elapse(hardware, ctx, 2 * self.settle_s)
        reached = hardware.read().position.copy()
        assert (np.abs(reached - goal) < 0.5 * np.abs(start - goal)).all(), "the joints did not stay at the command"
        return reached

    def _wait_for(self, hardware: Hardware, ctx: Context, goal: Vector, joint: int) -> None:
        """Let the joint come near its goal, as long as it gets nearer."""
        hardware.write(goal)
        left = abs(hardware.read().position[joint] - goal[joint])
        while left > self.move_rad / 2:
            self.elapse(hardware, ctx, self.settle_s / 2)
            before, left = left, abs(hardware.read().position[joint] - goal[joint])
            if left > before - self.quantum_rad:
                return

    def _check_rest(self, hardware: Hardware, ctx: Context, position: Vector) -> None:
        """Check that the joints stay at a position [rad], shape (J,), for `settle_s`."""
        self.elapse(hardware, ctx, self.settle_s)
        np.testing.assert_allclose(hardware.read().position, position, atol=self.tolerance_rad)

    def _relax(self, hardware: Hardware) -> Torque:
        """Skip the check for hardware that cannot relax."""
        try:
            return hardware.relax()
        except NotSupported:
            pytest.skip("has no torque control")

    def _target(self, hardware: Hardware, ctx: Context) -> Vector:
        position = hardware.read().position
        order = ctx.robot.indices(hardware.joints)
        middle = (ctx.robot.lower[order] + ctx.robot.upper[order]) / 2
        return np.asarray(position + np.where(position < middle, self.move_rad, -self.move_rad))

    def test_owns_the_joints_it_was_given(self) -> None:
        """`joints` is set by the constructor and equals `ctx.joints`."""
        ctx = self.context()
        assert self.make(ctx).joints == ctx.joints

    def test_reading_is_complete(self) -> None:
        """Every vector has one value per joint; positions and velocities are finite."""
        with self.connected() as (hardware, ctx):
            self.elapse(hardware, ctx, 0.0)
            reading = hardware.read()
            for name in ("position", "velocity", "effort"):
                vector = getattr(reading, name)
                assert vector.shape == (len(hardware.joints),), f"{name} has shape {vector.shape}"
                assert vector.dtype == np.float64, f"{name} has dtype {vector.dtype}"
            assert np.isfinite(reading.position).all()
            assert np.isfinite(reading.velocity).all()
            assert not np.isinf(reading.effort).any(), "effort that is not measured is NaN"

    def test_stamps_follow_the_clock(self) -> None:
        """A stamp is an int, not in the future, and later once time has passed."""
        with self.connected() as (hardware, ctx):
            previous = -1
            for _ in range(5):
                self.elapse(hardware, ctx, 0.0)
                stamp_ns = hardware.read().stamp_ns
                assert type(stamp_ns) is int
                assert previous < stamp_ns <= ctx.clock.now_ns()
                previous = stamp_ns

    def test_holds_where_it_is(self) -> None:
        """Without further commands, joints stay where the last one moved them."""
        with self.connected() as (hardware, ctx):
            self._check_rest(hardware, ctx, self.moved(hardware, ctx))

    def test_connecting_moves_nothing(self) -> None:
        """After `connect` the joints hold their positions, even if these are not zero."""
        with self.connected() as (hardware, ctx):
            self.moved(hardware, ctx)
            hardware.disconnect()
            hardware.connect()
            self._check_rest(hardware, ctx, hardware.read().position.copy())

    def test_readings_are_new(self) -> None:
        """While joints move, no reading repeats an older one under a new stamp, and two at one time agree."""
        with self.connected() as (hardware, ctx):
            hardware.read()
            hardware.write(self._target(hardware, ctx))
            positions = []
            for _ in range(max(6, round(ns(self.settle_s) / ctx.period_ns / 2))):
                self.elapse(hardware, ctx, 0.0)
                first, second = hardware.read().position.copy(), hardware.read().position.copy()
                positions.append(second)
                way = np.abs(second - positions[-2]).max() if len(positions) > 1 else self.move_rad
                assert np.abs(second - first).max() <= max(way / 4, self.quantum_rad), "the first reading was stale"
            steps = np.abs(np.diff(positions, axis=0)).max(axis=1)
            moving = np.minimum(steps[:-2], steps[2:]) > self.quantum_rad
            assert (steps[1:-1][moving] > 0).all(), "a reading repeats the one before under a new stamp"

    def test_reading_fits_into_a_control_period(self) -> None:
        """`read` and `write` do not block the loop: the quickest of several takes less than a period."""
        with self.connected() as (hardware, ctx):
            position = hardware.read().position.copy()
            for name, call in (("read", hardware.read), ("write", lambda: hardware.write(position))):
                quickest_s = min(_duration_s(call) for _ in range(5))
                assert quickest_s < ctx.period_ns / ns(1.0), f"{name} takes {quickest_s:.3f} s"

    def test_write_moves_each_joint_towards_its_command(self) -> None:
        """A command for one joint moves this joint, and no other."""
        with self.connected() as (hardware, ctx):
            for i, name in enumerate(hardware.joints):
                start = hardware.read().position.copy()
                goal = start.copy()
                goal[i] = self._target(hardware, ctx)[i]
                hardware.write(goal)
                self.elapse(hardware, ctx, self.settle_s)
                left = np.abs(hardware.read().position - goal)
                assert left[i] < 0.5 * abs(goal[i] - start[i]), f"{name} did not move half-way in {self.settle_s} s"
                assert np.delete(left, i).max(initial=0.0) < 0.5 * self.move_rad, f"{name} moved another joint"

    def test_reaches_the_ends_of_the_way(self) -> None:
        """Each joint follows commands to both ends of `reach`: the driver has no bounds of its own."""
        with self.connected() as (hardware, ctx):
            order = ctx.robot.indices(hardware.joints)
            lower, upper = ctx.robot.lower[order], ctx.robot.upper[order]
            middle, half = (lower + upper) / 2, self.reach / 2 * (upper - lower)
            goal = middle.copy()
            for i in range(len(goal)):
                self._wait_for(hardware, ctx, goal, i)
            for i, name in enumerate(hardware.joints):
                for end in (middle[i] - half[i], middle[i] + half[i]):
                    goal[i] = end
                    self._wait_for(hardware, ctx, goal, i)
                    measured = hardware.read().position[i]
                    assert abs(measured - end) <= self.move_rad, f"{name} stops at {measured:.2f} rad, not at {end:.2f}"
                goal[i] = middle[i]
                self._wait_for(hardware, ctx, goal, i)

    def test_velocity_is_that_of_the_motion(self) -> None:
        """Velocities of a moving joint add up to about the way that it went, in its direction: rad/s, not degrees."""
        with self.connected() as (hardware, ctx):
            for _ in range(5):  # so that a velocity made of differences has its readings
                self.elapse(hardware, ctx, 0.0)
                start = hardware.read()
            hardware.write(self._target(hardware, ctx))
            ways, before = np.zeros(len(hardware.joints)), start
            for _ in range(max(10, round(ns(self.settle_s) / ctx.period_ns))):
                self.elapse(hardware, ctx, 0.0)
                now = hardware.read()
                mean = (before.velocity + now.velocity) / 2
                ways, before = ways + mean * seconds(now.stamp_ns - before.stamp_ns), now
            went = before.position - start.position
            for name, way, true in zip(hardware.joints, ways, went, strict=True):
                # By a factor of 4 at most, for devices that move within a few ticks.
                assert 0.25 < way / true < 4, f"{name} went {true:.2f} rad, its velocities say {way:.2f}"

    def test_effort_is_measured_or_missing(self) -> None:
        """Effort that nothing measures is NaN: exactly 0 in motion and at rest, it would look like a free joint."""
        with self.connected() as (hardware, ctx):
            hardware.write(self._target(hardware, ctx))
            efforts = []
            for _ in range(20):
                self.elapse(hardware, ctx, 0.0)
                efforts.append(hardware.read().effort.copy())
            silent = [
                name for name, values in zip(hardware.joints, np.transpose(efforts), strict=True) if not values.any()
            ]
            assert not silent, f"effort of {', '.join(silent)} is 0 in all readings; what is not measured is NaN"

    def test_refuses_a_command_of_wrong_shape(self) -> None:
        """A vector of wrong length is refused (HardwareError or ValueError) and moves nothing."""
        with self.connected() as (hardware, ctx):
            before = self.moved(hardware, ctx)
            for size in (len(hardware.joints) + 1, len(hardware.joints) - 1, 1):
                if size != len(hardware.joints):
                    with pytest.raises((HardwareError, ValueError)):
                        hardware.write(np.zeros(size))
            self._check_rest(hardware, ctx, before)

    def test_keeps_no_hold_of_the_callers_arrays(self) -> None:
        """Later changes of the caller's array do not affect a command, and a reading does not change after `read`."""
        with self.connected() as (hardware, ctx):
            start = hardware.read()
            copy = start.position.copy()
            goal = self._target(hardware, ctx)
            command = goal.copy()
            hardware.write(command)
            np.testing.assert_array_equal(command, goal, err_msg="write changed its argument")
            command[:] = copy
            self.elapse(hardware, ctx, self.settle_s)
            now = hardware.read().position
            assert (np.abs(now - goal) < np.abs(now - copy)).all(), "the command changed with the caller's array"
            np.testing.assert_array_equal(start.position, copy, err_msg="an earlier reading changed")

    def test_disconnect_is_safe_at_any_time(self) -> None:
        """`disconnect` may be called before `connect` and twice; `connect` works again afterwards."""
        with self.connected(again=True) as (hardware, _):
            assert np.isfinite(hardware.read().position).all()

    def test_refuses_use_while_disconnected(self) -> None:
        """`read` and `write` raise HardwareError before `connect` and after `disconnect`: there are no values."""
        fresh = self.make(self.context())
        with pytest.raises(HardwareError):
            fresh.read()
        with pytest.raises(HardwareError):
            fresh.write(np.zeros(len(fresh.joints)))
        with self.connected() as (hardware, _):
            position = hardware.read().position
        with pytest.raises(HardwareError):
            hardware.read()
        with pytest.raises(HardwareError):
            hardware.write(position)

    def test_relax_reports_torque_and_what_holds_it(self) -> None:
        """`relax` is not supported, or returns the torque state; `holding` agrees, with a place and a command."""
        with self.connected() as (hardware, ctx):
            before = hardware.holding()
            outcome = self._relax(hardware)
            assert isinstance(outcome, Torque), f"relax returned {outcome!r}, not a Torque"
            after = hardware.holding()
            assert after is None or outcome is not Torque.OFF, f"torque is off, but holding returns {after}"
            hardware.write(hardware.read().position)
            self.elapse(hardware, ctx, 0.0)
            for holding in (before, hardware.holding()):
                if holding is not None:
                    assert holding.where, "holding names no place"
                    assert holding.command, "holding names no command that takes torque off"
            assert (hardware.holding() is None) == (before is None), "after a write it holds as it did before relax"

    def test_holding_is_known_while_disconnected(self) -> None:
        """`holding` works before `connect`, when nothing holds; `disconnect` does not change it."""
        assert self.make(self.context()).holding() is None
        with self.connected() as (hardware, _):
            held = hardware.holding()
        assert hardware.holding() == held

    def test_undone_connect_leaves_no_torque_of_its_own(self) -> None:
        """After `undo_connect` nothing holds, and the hardware can be connected again."""
        with self.connected() as (hardware, _):
            hardware.undo_connect()
            assert hardware.holding() is None
            hardware.disconnect()
            hardware.connect()
            assert np.isfinite(hardware.read().position).all()

    def test_conditions_are_of_its_joints(self) -> None:
        """Every condition of `health` is about a joint of this hardware, finite, unique, and has a message."""
        with self.connected() as (hardware, ctx):
            for _ in range(3):
                self.elapse(hardware, ctx, 0.5)
                hardware.read()
                conditions = hardware.health()
                for condition in conditions:
                    assert condition.joint in hardware.joints, f"{condition.joint!r} is not a joint of this hardware"
                    assert condition.quantity
                    assert np.isfinite(condition.value), f"{condition.quantity} of {condition.joint} is not finite"
                    assert condition.joint in condition.message, f"{condition.message!r} does not name its joint"
                keys = [(condition.joint, condition.quantity) for condition in conditions]
                assert len(set(keys)) == len(keys), f"two conditions of one quantity: {keys}"

    def test_relax_ends_with_the_next_write(self) -> None:
        """`relax` is not supported, or the next `write` switches the torque on again."""
        with self.connected() as (hardware, ctx):
            self._relax(hardware)
            self.elapse(hardware, ctx, 0.0)
            start = hardware.read().position.copy()
            goal = self._target(hardware, ctx)
            hardware.write(goal)
            self.elapse(hardware, ctx, 2 * self.settle_s)
            assert (np.abs(hardware.read().position - goal) < 0.5 * np.abs(goal - start)).all()

    def test_torque_returns_without_a_jump(self) -> None:
        """`relax` is not supported, or torque comes back where the joints are: a command to stay moves nothing."""
        with self.connected() as (hardware, ctx):
            self.moved(hardware, ctx)
            self._relax(hardware)
            self.elapse(hardware, ctx, 0.0)
            before = hardware.read().position.copy()
            for _ in range(max(1, round(ns(self.settle_s) / ctx.period_ns))):
                hardware.write(before)
                self.elapse(hardware, ctx, 0.0)
                away = np.abs(hardware.read().position - before).max()
                assert away < self.tolerance_rad, f"a joint jumped by {away:.3f} rad when torque came back"

    def test_the_device_loses_torque_with_relax_and_has_it_with_the_next_write(self) -> None:
        """What `relax` reports is what the device does."""
        with self.connected() as (hardware, ctx):
            assert self.has_torque(hardware), "the device has no torque after connect"
            if self._relax(hardware) is Torque.OFF:
                assert not self.has_torque(hardware), "relax reports OFF, but the device still has torque"
            hardware.write(hardware.read().position)
            self.elapse(hardware, ctx, 0.0)
            assert self.has_torque(hardware), "the device has no torque after a write"

    def test_the_device_keeps_its_torque_when_it_is_disconnected(self) -> None:
        """`disconnect` drops no arm: what holds without a process goes on, and `undo_connect` leaves no torque."""
        with self.connected() as (hardware, _):
            self.has_torque(hardware)
            if hardware.holding() is None:
                pytest.skip("holds nothing without a process")
            hardware.disconnect()
            assert self.has_torque(hardware), "disconnect took the torque off: an arm falls"
            hardware.connect()
            hardware.undo_connect()
            assert not self.has_torque(hardware), "undo_connect left the torque on"

    def test_a_lost_reply_is_no_new_reading(self) -> None:
        """Without replies, `read` raises HardwareError, or the reading is stale, or has the stamp of the last reply."""
        with self.connected() as (hardware, ctx):
            hardware.write(self._target(hardware, ctx))
            self.elapse(hardware, ctx, self.settle_s / 4)
            last_ns = hardware.read().stamp_ns
            self.lose_replies(hardware)
            for _ in range(10):
                self.elapse(hardware, ctx, 0.0)
                try:
                    reading = hardware.read()
                except HardwareError:
                    return
                fresh = reading.stamp_ns > last_ns and not reading.stale
                assert not fresh, "a reading has a new stamp and is not stale, though nothing answered"

    def test_an_unplugged_device_is_an_error(self) -> None:
        """`read` raises HardwareError within a second, and `disconnect` still works."""
        with self.connected() as (hardware, ctx):
            hardware.write(hardware.read().position)
            self.unplug(hardware)

            def until_gone() -> None:
                for _ in range(max(10, round(ns(1.0) / ctx.period_ns))):
                    self.elapse(hardware, ctx, 0.0)
                    hardware.read()

            with pytest.raises(HardwareError):
                until_gone()

    def test_a_blocked_joint_is_measured_where_it_is(self) -> None:
        """Positions are measured: those of a joint that cannot move do not follow its commands."""
        with self.connected() as (hardware, ctx):
            start = hardware.read().position.copy()
            self.stall(hardware, 0)
            hardware.write(self._target(hardware, ctx))
            self.elapse(hardware, ctx, self.settle_s)
            way = abs(hardware.read().position[0] - start[0])
            assert way < self.move_rad / 4, f"a blocked joint is said to have moved {way:.2f} rad"

    def test_reset_faults_moves_nothing(self) -> None:
        """`reset_faults` on healthy hardware changes nothing."""
        with self.connected() as (hardware, ctx):
            before = self.moved(hardware, ctx)
            hardware.reset_faults()
            self._check_rest(hardware, ctx, before)

    def test_signals_fill_their_vectors(self) -> None:
        """Every declared signal has a unique topic and writes as many values as it declares."""
        with self.connected() as (hardware, ctx):
            self.elapse(hardware, ctx, 0.0)
            topics = [signal.topic for signal in hardware.signals]
            assert len(set(topics)) == len(topics), f"a topic twice in {topics}"
            for i, signal in enumerate(hardware.signals):
                assert signal.topic.startswith("/"), f"topic {signal.topic!r} must begin with /"
                assert signal.size > 0
                first, second = np.full(signal.size, 1e300), np.full(signal.size, -1e300)
                hardware.read_signal(i, first)
                hardware.read_signal(i, second)
                assert not ((first == 1e300) | (second == -1e300)).any(), f"{signal.topic} leaves numbers unwritten"


def _duration_s(call: Callable[[], object]) -> float:
    begun = time.perf_counter()
    call()
    return time.perf_counter() - begun


class SimulatedHardwareSuite(HardwareSuite):
    """Checks of every `SimulatedHardware`, in addition to `HardwareSuite`."""

    def _run(self, hardware: SimulatedHardware, ctx: Context, seed: int) -> list[JointReading]:
        hardware.reset(EpisodeSetup(seed))
        readings = [hardware.read()]
        hardware.write(self._target(hardware, ctx))
        for _ in range(20):
            self.elapse(hardware, ctx, 0.0)
            readings.append(hardware.read())
        return readings

    @contextmanager
    def simulated(self) -> Iterator[tuple[SimulatedHardware, Context]]:
        """Connected simulated hardware with its context."""
        with self.connected() as (hardware, ctx):
            assert isinstance(hardware, SimulatedHardware)
            yield hardware, ctx

    def test_time_passes_only_by_advance(self) -> None:
        """Two readings without `advance` in between are equal, independent of the clock."""
        with self.simulated() as (hardware, ctx):
            hardware.write(self._target(hardware, ctx))
            self.elapse(hardware, ctx, 0.0)
            first = hardware.read()
            if isinstance(ctx.clock, SteppedClock):
                ctx.clock.advance(10 * ctx.period_ns)
            second = hardware.read()
            np.testing.assert_array_equal(first.position, second.position)
            np.testing.assert_array_equal(first.velocity, second.velocity)

    def test_equal_seeds_run_alike(self) -> None:
        """After `reset` with the same seed, the same commands give identical results, whatever happened before."""
        with self.simulated() as (hardware, ctx):
            first = self._run(hardware, ctx, 7)
            signals = self._signals(hardware)
            self._run(hardware, ctx, 8)
            second = self._run(hardware, ctx, 7)
            for a, b in zip(first, second, strict=True):
                np.testing.assert_array_equal(a.position, b.position)
                np.testing.assert_array_equal(a.velocity, b.velocity)
            for x, y in zip(signals, self._signals(hardware), strict=True):
                np.testing.assert_array_equal(x, y)

    def test_equal_seeds_run_alike_in_another_object(self) -> None:
        """A second simulation with the same seed gives identical results."""
        with self.simulated() as (hardware, ctx), self.simulated() as (twin, twin_ctx):
            for a, b in zip(self._run(hardware, ctx, 7), self._run(twin, twin_ctx, 7), strict=True):
                np.testing.assert_array_equal(a.position, b.position)

    def test_reset_holds(self) -> None:
        """After `reset` nothing moves: old commands are discarded."""
        with self.simulated() as (hardware, ctx):
            self.moved(hardware, ctx)
            hardware.reset(EpisodeSetup(1))
            self._check_rest(hardware, ctx, hardware.read().position.copy())

    def test_success_is_a_verdict(self) -> None:
        """`success` is True, False or None, and never True right after a reset."""
        with self.simulated() as (hardware, _):
            hardware.reset(EpisodeSetup(1))
            assert hardware.success() in (False, None)

    @staticmethod
    def _signals(hardware: Hardware) -> list[Vector]:
        values = [np.empty(signal.size) for signal in hardware.signals]
        for i, out in enumerate(values):
            hardware.read_signal(i, out)
        return values
