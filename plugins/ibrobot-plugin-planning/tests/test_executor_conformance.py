"""The executors pass the suite of executors."""

from __future__ import annotations

import math
from typing import override

import attrs
import numpy as np
from ibrobot_planning.executors.gripper import GripperExecutor
from ibrobot_planning.executors.options import GripperOptions, TrajectoryOptions
from ibrobot_planning.executors.trajectory import TrajectoryExecutor
from ibrobot_testing import ExecutorSuite
from ibrobot_testing.contexts import GRIPPER, control_context

from ibrobot_core.api import FollowTrajectory, Header, JointTrajectory, JointTrajectoryPoint, MoveJoint


class TestTrajectory(ExecutorSuite):
    @override
    def make(self, ctx):
        return TrajectoryExecutor(TrajectoryOptions(), ctx)

    @override
    def goal(self, ctx, position):
        point = JointTrajectoryPoint(2_000_000_000, position, np.zeros(len(position)))
        return FollowTrajectory(JointTrajectory(Header(), ctx.joints, (point,)))

    @override
    def wrong_goals(self, ctx):
        right = self.goal(ctx, self.poses(ctx)[1])
        other = attrs.evolve(right.trajectory, joint_names=ctx.joints[1:])
        return [MoveJoint(0.0), FollowTrajectory(other), attrs.evolve(right, path_tolerance=-3.0)]


class TestGripper(ExecutorSuite):
    @override
    def context(self):
        return control_context(joints=GRIPPER)

    @override
    def make(self, ctx):
        return GripperExecutor(GripperOptions(), ctx)

    @override
    def goal(self, ctx, position):
        return MoveJoint(float(position[0]))

    @override
    def wrong_goals(self, ctx):
        return [FollowTrajectory(JointTrajectory(Header(), ctx.joints, ())), MoveJoint(99.0), MoveJoint(math.nan)]
