"""The plugin's hooks: planner type `joint`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import PlannerDescriptor, hookimpl
from ibrobot_planning.options import JointPlannerOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Context, Planner


def _joint(options: Any, ctx: Context) -> Planner:
    from ibrobot_planning.joint import JointPlanner

    return JointPlanner(options, ctx)


@hookimpl
def ibrobot_planners() -> Iterable[PlannerDescriptor]:
    """Straight lines between joint positions."""
    yield PlannerDescriptor(
        type="joint", options=JointPlannerOptions, make=_joint,
        summary="straight line in joint space, time-optimal within velocity, acceleration and jerk limits",
    )  # fmt: skip
