"""Errors of goals, with MoveIt's codes."""

from __future__ import annotations

from ibrobot_core.api import PlanCode, PlanningError


def invalid_goal(message: str) -> PlanningError:
    """The error for an invalid goal."""
    return PlanningError(message, PlanCode.INVALID_GOAL_CONSTRAINTS)


def unreachable(message: str) -> PlanningError:
    """The error for a goal that the arm cannot reach."""
    return PlanningError(message, PlanCode.NO_IK_SOLUTION)
