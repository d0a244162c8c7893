"""The executors pass the suite of executors."""

from __future__ import annotations

from typing import override

from ibrobot_planning.executors.gripper import GripperExecutor
from ibrobot_planning.executors.options import GripperOptions, TrajectoryOptions
from ibrobot_planning.executors.trajectory import TrajectoryExecutor
from ibrobot_testing import ExecutorSuite
from ibrobot_testing.contexts import GRIPPER, control_context


class TestTrajectory(ExecutorSuite):
    @override
    def make(self, ctx):
        return TrajectoryExecutor(TrajectoryOptions(), ctx)

    @override
    def goal(self, ctx, position):
        at_rest = [0.0] * len(position)
        point = {"time_from_start_ns": 2_000_000_000, "positions": position.tolist(), "velocities": at_rest}
        return {"trajectory": {"joint_names": list(ctx.joints), "points": [point]}}

    @override
    def wrong_goals(self, ctx):
        right = self.goal(ctx, self.poses(ctx)[1])
        names = {"joint_names": list(ctx.joints[1:]), "points": right["trajectory"]["points"]}
        return [{}, {"trajectory": names}, {**right, "path_tolerance": -3}]


class TestGripper(ExecutorSuite):
    @override
    def context(self):
        return control_context(joints=GRIPPER)

    @override
    def make(self, ctx):
        return GripperExecutor(GripperOptions(), ctx)

    @override
    def goal(self, ctx, position):
        return {"position": float(position[0])}

    @override
    def wrong_goals(self, ctx):
        return [{}, {"position": 99.0}, {"position": "open"}]
