"""The gripper executor in stepped time: reached, stalled, squeezing, cancelled."""

from __future__ import annotations

import logging
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_planning.executors.gripper import GripperExecutor
from ibrobot_planning.executors.options import GripperOptions

from ibrobot_core.api import (
    Context,
    ExecutorGoal,
    FollowTrajectory,
    GoalRejected,
    GoalState,
    GoalStatus,
    Header,
    Joint,
    JointReading,
    JointTrajectory,
    MoveJoint,
    NotSupported,
    Robot,
    SlowDown,
    SteppedClock,
)

PERIOD_NS = 10_000_000
ROBOT = Robot(
    name="robot",
    joints=(
        Joint(name="arm", lower=-3, upper=3, max_velocity=1, max_acceleration=1),
        Joint(name="jaw", lower=-0.2, upper=1.7, max_velocity=4, max_acceleration=40),
    ),
)


def context(*joints: str) -> Context:
    return Context(name="grip", clock=SteppedClock(), log=logging.getLogger("test"), robot=ROBOT, joints=joints)


class Jaw:
    """A jaw that follows its setpoint at once, but not past `blocked_at` on the way down."""

    def __init__(self, start: float = 1.5, blocked_at: float = -9.0, effort: float = np.nan, **options: Any) -> None:
        self.executor = GripperExecutor(GripperOptions(**options), context("jaw"))
        self.blocked_at, self.effort = blocked_at, effort
        self.now_ns, self.position, self.velocity, self.setpoint = 0, start, 0.0, start
        self.executor.activate(self.reading())

    def reading(self) -> JointReading:
        def vector(value: float) -> Any:
            return np.array([value])

        return JointReading(self.now_ns, vector(self.position), vector(self.velocity), vector(self.effort))

    def close(self, position: float = 0.0, goal_id: str = "close", **more: Any) -> None:
        self.executor.set_goal(goal_id, MoveJoint(position, **more), self.reading())

    def stop(self, rest: float | None = None) -> None:
        """Let it slow down; commands that brake now come to `rest`, by default those that follow the setpoint."""
        ticks = int(abs(self.velocity) / 0.4)
        braking = np.copysign(ticks * (abs(self.velocity) * 0.01 - (ticks + 1) * 0.002), self.velocity)
        at = self.setpoint + float(braking) if rest is None else rest
        self.executor.set_goal("stop", SlowDown(), attrs.evolve(self.reading(), position=np.array([at])))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            self.now_ns += PERIOD_NS
            self.setpoint = float(self.executor.update(self.reading())[0])
            position = max(self.setpoint, self.blocked_at)
            self.velocity = (position - self.position) / 0.01
            self.position = position

    def statuses(self) -> list[GoalStatus]:
        return list(iter(self.executor.pop_status, None))


def test_it_holds_the_measured_position_after_activation() -> None:
    jaw = Jaw(start=0.7)
    jaw.run(1.0)
    assert jaw.setpoint == 0.7
    assert jaw.statuses() == []


def test_it_moves_at_its_velocity_and_says_when_it_is_there() -> None:
    jaw = Jaw(start=1.0, velocity=2.0)
    jaw.close(0.5)
    assert [s.state for s in jaw.statuses()] == [GoalState.EXECUTING]
    jaw.run(0.1)
    assert jaw.setpoint == pytest.approx(0.84, abs=0.002), "after a tick at full speed less for every 0.4 rad/s"
    assert jaw.velocity == pytest.approx(-2.0)
    assert jaw.statuses() == []
    jaw.run(0.25)
    assert jaw.setpoint == pytest.approx(0.5)
    (status,) = jaw.statuses()
    assert (status.goal_id, status.state) == ("close", GoalState.SUCCEEDED)
    assert status.result["reached_goal"] is True
    assert status.result["stalled"] is False
    assert status.result["position"] == pytest.approx(0.5, abs=0.01)


def test_a_stall_counts_as_grasped_and_the_setpoint_goes_on_squeezing() -> None:
    jaw = Jaw(start=1.0, blocked_at=0.6, velocity=2.0, stall_time=0.5)
    jaw.close(0.0)
    jaw.run(0.69)  # 0.2 s to the object, 0.01 s until it is seen to stand, then 0.5 s
    assert [s.state for s in jaw.statuses()] == [GoalState.EXECUTING]
    jaw.run(0.05)
    (status,) = jaw.statuses()
    assert status == GoalStatus(
        "close",
        GoalState.SUCCEEDED,
        "stalled at 0.6 rad on the way to 0",
        {"position": 0.6, "stalled": True, "reached_goal": False},
    )
    jaw.run(1.0)
    assert jaw.setpoint == 0.0
    assert jaw.position == 0.6
    assert jaw.statuses() == []


def test_where_stalling_is_not_allowed_it_aborts_and_holds_the_measured_position() -> None:
    jaw = Jaw(start=1.0, blocked_at=0.6, velocity=2.0, stall_time=0.2, allow_stalling=False)
    jaw.close(0.0)
    jaw.run(1.0)
    _, status = jaw.statuses()
    assert status.state is GoalState.ABORTED
    assert status.message == "stalled at 0.6 rad on the way to 0"
    assert jaw.setpoint == 0.6


@pytest.mark.parametrize("allowed", [True, False])
def test_what_the_guard_holds_back_is_no_grasp(allowed: bool) -> None:
    jaw = Jaw(start=1.0, blocked_at=0.6, velocity=2.0, stall_time=0.2, allow_stalling=allowed)
    jaw.close(0.0)
    for _ in range(60):
        jaw.executor.note_guard('{"distance": 0.0031, "text": "finger was 3.1 mm from wall"}')
        jaw.run(0.01)
    status = jaw.statuses()[-1]
    assert (status.state, status.message) == (GoalState.ABORTED, "the guard: finger was 3.1 mm from wall")
    assert jaw.setpoint == pytest.approx(0.6), "it does not squeeze"


def test_a_grasp_that_the_guard_keeps_from_squeezing_more_is_one() -> None:
    jaw = Jaw(start=1.0, blocked_at=0.6, velocity=2.0, stall_time=0.2)
    jaw.close(0.0)
    for _ in range(60):
        jaw.executor.note_guard('{"distance": -0.0098, "text": "cube was -9.8 mm from finger"}')
        jaw.run(0.01)
    assert jaw.statuses()[-1].state == GoalState.SUCCEEDED


def test_a_slow_gripper_that_moves_does_not_stall() -> None:
    jaw = Jaw(start=1.0, velocity=0.05, stall_velocity=0.01, stall_time=0.1)
    jaw.close(0.9)
    jaw.run(1.5)
    assert jaw.statuses() == [GoalStatus("close", GoalState.EXECUTING)]
    jaw.run(1.0)
    assert jaw.statuses()[0].result["reached_goal"] is True


def test_a_stall_needs_the_speed_to_stay_low_without_a_break() -> None:
    jaw = Jaw(start=1.0, blocked_at=0.9, stall_time=0.3)
    jaw.close(0.0)
    jaw.run(0.25)
    jaw.blocked_at = 0.8
    jaw.run(0.25)
    assert len(jaw.statuses()) == 1
    jaw.run(0.2)
    assert jaw.statuses()[0].result["stalled"] is True


def test_a_pause_of_the_control_loop_is_no_stall() -> None:
    jaw = Jaw(start=1.0, velocity=2.0, stall_time=0.5)
    jaw.close(0.5)
    for _ in range(3):
        jaw.now_ns += 700_000_000
        jaw.run(0.01)
    assert jaw.statuses() == [GoalStatus("close", GoalState.EXECUTING)]
    jaw.run(1.0)
    assert jaw.statuses()[0].result["reached_goal"] is True


def test_max_effort_ends_the_squeezing_also_after_the_goal() -> None:
    jaw = Jaw(start=1.0, effort=0.1, velocity=2.0, stall_time=0.2)
    jaw.close(0.0, max_effort=0.8)
    jaw.run(0.1)
    jaw.effort = -0.9
    squeezed = jaw.setpoint
    jaw.run(1.0)
    assert jaw.setpoint == squeezed
    assert jaw.statuses()[-1].result["stalled"] is True
    jaw.effort = 0.1
    jaw.run(1.0)
    assert jaw.setpoint == pytest.approx(0.0, abs=1e-9)


def test_a_new_goal_replaces_the_old_from_the_present_setpoint() -> None:
    jaw = Jaw(start=1.0, velocity=2.0)
    jaw.close(0.0, "first")
    jaw.run(0.1)
    before = jaw.velocity
    jaw.close(1.0, "second")
    jaw.run(0.01)
    assert before < jaw.velocity <= before + 0.4, "it slows down within 40 rad/s²"
    jaw.run(0.7)
    assert [(s.goal_id, s.state, s.message) for s in jaw.statuses()] == [
        ("first", GoalState.EXECUTING, ""),
        ("first", GoalState.CANCELED, "replaced by goal second"),
        ("second", GoalState.EXECUTING, ""),
        ("second", GoalState.SUCCEEDED, ""),
    ]


def test_cancelling_holds_the_measured_position() -> None:
    jaw = Jaw(start=1.0, blocked_at=0.6, velocity=2.0)
    jaw.close(0.0)
    jaw.run(0.3)
    jaw.executor.cancel(jaw.reading())
    jaw.run(0.5)
    assert jaw.setpoint == 0.6
    assert jaw.statuses()[-1].state is GoalState.CANCELED
    jaw.executor.cancel(jaw.reading())
    assert jaw.statuses() == []


def test_stop_slows_down_and_holds() -> None:
    jaw = Jaw(start=1.0, velocity=2.0)
    jaw.close(0.0)
    jaw.run(0.1)
    before = jaw.setpoint
    jaw.stop()
    jaw.run(0.1)
    assert jaw.setpoint == pytest.approx(before - 2.0**2 / (2 * 40), abs=0.012)
    assert jaw.velocity == 0
    assert [(s.goal_id, s.state) for s in jaw.statuses()] == [
        ("close", GoalState.EXECUTING),
        ("close", GoalState.CANCELED),
        ("stop", GoalState.EXECUTING),
        ("stop", GoalState.SUCCEEDED),
    ]


@pytest.mark.parametrize(("target", "rest"), [(0.0, 0.95), (1.7, 1.05)])
def test_stop_holds_where_the_commands_come_to_rest_though_the_setpoint_is_ahead(target: float, rest: float) -> None:
    jaw = Jaw(start=1.0, velocity=2.0)
    jaw.close(target)
    jaw.run(0.2)
    assert abs(jaw.setpoint - 1.0) > 0.3
    jaw.stop(rest)
    jaw.run(0.01)
    assert jaw.setpoint == rest
    jaw.run(1.0)
    assert jaw.setpoint == rest
    assert [(s.goal_id, s.state) for s in jaw.statuses()][-1] == ("stop", GoalState.SUCCEEDED)


def test_goal_keeps_to_its_fraction_of_the_velocity_limit() -> None:
    jaw = Jaw(start=1.0)
    jaw.close(0.0, speed=0.1)
    jaw.run(0.5)
    assert jaw.velocity == pytest.approx(-0.4)
    jaw.close(1.7, "open")
    jaw.run(0.3)
    assert jaw.velocity == pytest.approx(2.0)


def test_gripper_that_may_only_creep_has_not_stalled() -> None:
    jaw = Jaw(start=1.0, stall_velocity=0.05, stall_time=0.1)
    jaw.close(0.9, speed=0.005)
    jaw.run(1.0)
    assert jaw.statuses() == [GoalStatus("close", GoalState.EXECUTING)]
    jaw.blocked_at = jaw.position
    jaw.run(0.2)
    assert jaw.statuses()[0].result["stalled"] is True


def test_deactivation_ends_the_goal() -> None:
    jaw = Jaw()
    jaw.close()
    jaw.executor.deactivate()
    assert jaw.statuses()[-1] == GoalStatus("close", GoalState.CANCELED, "the executor was deactivated")
    with pytest.raises(GoalRejected, match="not active"):
        jaw.close()


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (FollowTrajectory(JointTrajectory(Header(), ("jaw",), ())), "expected a position, got FollowTrajectory("),
        (MoveJoint(float("nan")), "position must be a finite number, got nan"),
        (MoveJoint(0.0, speed=0.0), "speed is 0; it must be a fraction above 0, up to 1"),
        (MoveJoint(0.0, speed=1.5), "speed is 1.5; it must be a fraction"),
        (MoveJoint(0.0, speed=float("nan")), "speed must be a finite number, got nan"),
        (MoveJoint(2.0), "position 2 rad is outside the limits of jaw, -0.2 to 1.7"),
        *(
            (MoveJoint(1.0, value), f"max_effort must be a finite number, got {value!r}")
            for value in (float("nan"), float("inf"), -float("inf"))
        ),
        (MoveJoint(1.0, -1), "max_effort is -1 Nm; it must be from 0, for no limit, to 1000"),
        (MoveJoint(1.0, 1e308), "max_effort is 1e+308 Nm; it must be from 0, for no limit, to 1000"),
        (MoveJoint(1.0, 1), "max_effort cannot be kept: jaw has no measured effort; leave it out"),
    ],
)
def test_a_bad_goal_is_rejected_and_the_old_one_goes_on(goal: ExecutorGoal, message: str) -> None:
    jaw = Jaw(start=1.0)
    jaw.close(0.5)
    with pytest.raises(GoalRejected) as caught:
        jaw.executor.set_goal("bad", goal, jaw.reading())
    assert str(caught.value).startswith(message)
    jaw.run(1.0)
    assert [(s.goal_id, s.state) for s in jaw.statuses()] == [
        ("close", GoalState.EXECUTING),
        ("close", GoalState.SUCCEEDED),
    ]


def test_a_max_effort_of_zero_means_no_limit_and_needs_no_measured_effort() -> None:
    jaw = Jaw(start=1.0)
    jaw.close(0.5, max_effort=0.0)
    jaw.run(1.0)
    assert jaw.statuses()[-1].state is GoalState.SUCCEEDED


def test_a_gripper_has_one_joint() -> None:
    with pytest.raises(NotSupported, match="grip: a gripper has one joint, this group has 2: arm, jaw"):
        GripperExecutor(GripperOptions(), context("arm", "jaw"))
