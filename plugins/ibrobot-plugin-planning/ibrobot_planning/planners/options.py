"""Options of the planners."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


@documented
@attrs.frozen
class JointPlannerOptions(Options):
    """Options of `type: joint`."""

    velocity_scaling: float = option(1.0, gt=0, le=1, help="fraction of the velocity limits for a scaling of 1.0")
    acceleration_scaling: float = option(
        1.0, gt=0, le=1, help="fraction of the acceleration limits for a scaling of 1.0"
    )
    max_jerk: float = option(200.0, unit="rad/s^3", gt=0, help="maximum jerk of any joint")
    step: float = option(0.02, unit="s", ge=0.001, help="longest time between points of the trajectory")


@documented
@attrs.frozen
class GoalCheckOptions(Options):
    """The section `goals`: how far trajectories of any client keep away, in modes whose planner does not say so."""

    padding: float = option(0.005, unit="m", ge=0, le=0.1, help="minimum distance of the arm from objects")
    self_padding: float = option(0.0, unit="m", ge=0, le=0.1, help="minimum distance between links of the arm")
    floor: float | None = option(
        None,
        unit="m",
        help="height of the table or floor in the base frame; everything below is blocked; none: that of"
        " robot.description",
    )


@documented
@attrs.frozen
class RrtConnectOptions(GoalCheckOptions):
    """Options of `type: rrt_connect`."""

    planning_time: float = option(5.0, unit="s", gt=0, help="time limit of a search")
    velocity_scaling: float = option(1.0, gt=0, le=1, help="fraction of the velocity limits for a scaling of 1.0")
    acceleration_scaling: float = option(
        1.0, gt=0, le=1, help="fraction of the acceleration limits for a scaling of 1.0"
    )
    max_jerk: float = option(400.0, unit="rad/s^3", gt=0, help="maximum jerk of any joint")
    step: float = option(0.01, unit="s", ge=0.002, le=0.05, help="time between points of the trajectory")
    blend: float = option(
        0.5, unit="rad", ge=0, help="distance from a corner of the path at which the arm may leave it"
    )
    start_beyond_limits: float = option(
        0.1, unit="rad", ge=0, help="how far outside its limits a joint may start; from there it moves only inwards"
    )
    start_overlap: float = option(
        0.01,
        unit="m",
        ge=0,
        help="how deep the arm may overlap something at the start; from there it moves only outwards",
    )

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has a model."""
        if robot.description.mjcf is None:
            yield OptionFault((), "planning around obstacles needs robot.description.mjcf: set it", "mjcf")
