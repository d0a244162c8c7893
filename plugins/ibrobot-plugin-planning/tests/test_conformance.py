"""Both planners pass the suite of planners."""

from __future__ import annotations

from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_planning.planner import JointGoal, PlanRequest
from ibrobot_planning.planners.joint import JointPlanner
from ibrobot_planning.planners.options import JointPlannerOptions, RrtConnectOptions
from ibrobot_planning.planners.rrt import RrtConnectPlanner
from ibrobot_planning.suite import PlannerSuite
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.collision import Collisions, unchecked_pairs
from ibrobot_planning.world.engines import find_engines
from ibrobot_planning.world.objects import World
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import Context, MissingDependency
from ibrobot_core.app import installed_plugins

from .table_arm import make_robot


class TestJointPlanner(PlannerSuite):
    @override
    def make(self, ctx: Context) -> JointPlanner:
        return JointPlanner(JointPlannerOptions(), ctx)


class TestRrtConnectPlanner(PlannerSuite):
    @pytest.fixture(autouse=True)
    def folder(self, tmp_path):
        self._folder = tmp_path

    @override
    def context(self) -> Context:
        return attrs.evolve(super().context(), robot=make_robot(self._folder))

    @override
    def make(self, ctx: Context) -> RrtConnectPlanner:
        return RrtConnectPlanner(RrtConnectOptions(), ctx)

    @override
    def request(self, ctx: Context, seed: int, joints: tuple[str, ...] | None = None) -> PlanRequest:
        """Between random configurations that touch nothing, others at zero."""
        joints = ctx.robot.joint_names if joints is None else joints
        arm = robot_arm(ctx.robot)
        checks = Collisions(attrs.evolve(arm, unchecked=unchecked_pairs(arm)), World(), joints)
        order = ctx.robot.indices(joints)
        samples = np.random.default_rng(seed).uniform(ctx.robot.lower[order], ctx.robot.upper[order], (99, len(joints)))
        # One joint of the goal alone must be free as well: the suite asks for that.
        free = [q for q in samples if checks.free(q)]
        start = free[0]
        for goal in free[1:]:
            mixed = start.copy()
            mixed[1] = goal[1]
            if checks.free(mixed):
                return PlanRequest(joints, start, JointGoal(joints, goal))
        raise AssertionError("no free goal")


def test_missing_system_library_is_named_with_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("ctypes.CDLL", load)
    with pytest.raises(MissingDependency, match="sudo apt-get install libgomp1"):
        find_engines()
    with pytest.raises(MissingDependency, match="sudo apt-get install libgomp1"):
        installed_plugins().create("planner", "rrt_connect", RrtConnectOptions(), host_context())
