"""Options of the executors `trajectory` and `gripper`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import Options, documented, option


@documented
@attrs.frozen
class TrajectoryOptions(Options):
    """Options of `type: trajectory`; a tolerance of 0 is not checked."""

    path_tolerance: float = option(0.0, unit="rad", ge=0, help="largest deviation on the way, beyond a lag of 0.1 s")
    goal_tolerance: float = option(0.02, unit="rad", ge=0, help="largest deviation at the end")
    goal_time: float = option(1.0, unit="s", ge=0, help="time after the end to come within goal_tolerance; 0: no limit")


@documented
@attrs.frozen
class GripperOptions(Options):
    """Options of `type: gripper`."""

    goal_tolerance: float = option(0.01, unit="rad", gt=0, help="deviation at which the goal counts as reached")
    stall_velocity: float = option(0.01, unit="rad/s", gt=0, help="speed below which the gripper counts as stalled")
    stall_time: float = option(0.5, unit="s", gt=0, help="time below the stall velocity before it counts")
    allow_stalling: bool = option(True, help="whether a stall is a success (something was grasped)")
    velocity: float = option(2.0, unit="rad/s", gt=0, help="speed of opening and closing")
