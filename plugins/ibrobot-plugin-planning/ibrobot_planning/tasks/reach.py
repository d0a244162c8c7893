"""Whether the tool can reach a goal, by inverse kinematics."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ibrobot_core.api import PlanningError, Robot, Vector
from ibrobot_core.app import AnyGoal, Goal, LinearGoal, PoseGoal, PositionGoal

if TYPE_CHECKING:
    from ibrobot_planning.goals.tool import Tool


class Reach:
    """Checks the reach of a robot; the first check reads its model.

    Args:
        robot: the robot.
        start: all joints [rad], shape (J,); None if they are not known.
    """

    def __init__(self, robot: Robot, start: Vector | None) -> None:
        self._robot, self._start = robot, start

    def check(self, goal: Goal) -> None:
        """Check that all waypoints of a goal, or one of its alternatives, can be reached.

        Raises:
            PlanningError: if not, or without a model of the robot.
        """
        if isinstance(goal, LinearGoal):
            for waypoint in goal.waypoints:
                self.check(waypoint)
        elif isinstance(goal, AnyGoal):
            errors = []
            for each in goal.goals:
                try:
                    self.check(each)
                except PlanningError as error:
                    errors.append(error)
            if len(errors) == len(goal.goals):
                raise errors[0]
        elif isinstance(goal, PositionGoal | PoseGoal):
            model, start = self._tool.model, self._start
            self._tool.candidates(goal, np.clip(0.0, model.lower, model.upper) if start is None else start)

    @cached_property
    def _tool(self) -> Tool:
        from ibrobot_kinematics import KinematicsError, robot_model

        from ibrobot_planning.goals.tool import Tool

        try:
            return Tool(robot_model(self._robot))
        except KinematicsError as error:
            raise PlanningError(str(error)) from error
