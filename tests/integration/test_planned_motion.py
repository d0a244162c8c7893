"""Short variants of `benchmarks/planned_motion.py`: obstacles that appear and lost joints, in seeded physics."""

from __future__ import annotations

import planned_motion
import pytest

pytestmark = pytest.mark.integration


def test_arm_stands_before_an_obstacle_that_appears():
    assert planned_motion.obstacles(1, seed=6)


def test_blocked_arm_lost_joint_and_silent_hardware_stop_the_arm_with_the_cause():
    assert planned_motion.losses(3, seed=3)
