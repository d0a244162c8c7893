"""The joint planner passes the suite of planners."""

from __future__ import annotations

from typing import override

from ibrobot_planning.joint import JointPlanner
from ibrobot_planning.options import JointPlannerOptions
from ibrobot_testing import PlannerSuite

from ibrobot_core.api import Context


class TestJointPlanner(PlannerSuite):
    @override
    def make(self, ctx: Context) -> JointPlanner:
        return JointPlanner(JointPlannerOptions(), ctx)
