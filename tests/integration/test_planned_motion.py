"""Obstacles that appear, goals that are cancelled or replaced, and lost joints, in seeded physics."""

from __future__ import annotations

import planned_motion
import pytest

pytestmark = pytest.mark.integration


def test_arm_stands_before_an_obstacle_that_appears():
    assert planned_motion.obstacles(1, seed=6)


def test_cancelled_and_replaced_goals_leave_the_limits_and_the_safety_layer_in_peace():
    assert planned_motion.goals(4, seed=2)


def test_blocked_arm_lost_joint_and_silent_hardware_stop_the_arm_with_the_cause():
    assert planned_motion.losses(3, seed=3)
