"""Actions of LeRobot's programs: what is refused, and what joints without a position do."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_lerobot_program.features import RobotFeatures
from ibrobot_lerobot_program.run import ProgramSource

from ibrobot_core.api import Joint, Robot
from ibrobot_core.app import ComponentFailed

pytestmark = pytest.mark.lerobot

FEATURES = RobotFeatures(("pan", "lift"), np.array([0.1, 0.1]), np.array([0.0, 1.0]), {}, 30.0)
ROBOT = Robot("two", tuple(Joint(name, -2.0, 2.0, max_velocity=3.0, max_acceleration=40.0) for name in ("lift", "pan")))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), None, "3", "far", [1.0, 2.0], {}, True])
def test_a_value_that_is_no_finite_number_is_named(value: object) -> None:
    with pytest.raises(ComponentFailed, match=re.escape(f"lift.pos is {value!r}: give a finite number")):
        FEATURES.radians({"pan.pos": 1.0, "lift.pos": value})


def test_an_unknown_feature_is_named_with_the_available_ones() -> None:
    with pytest.raises(ComponentFailed, match=r"no feature .pan.; the features are: pan\.pos, lift\.pos"):
        FEATURES.radians({"pan": 1.0})


def test_numbers_of_any_kind_are_positions() -> None:
    assert FEATURES.radians({"lift.pos": np.float32(2.0), "pan.pos": 3}) == {"lift": 1.2, "pan": pytest.approx(0.3)}


class Source(ProgramSource):
    """Without a channel."""

    def __init__(self) -> None:
        self.plans: list[tuple[tuple[str, ...], list[float]]] = []
        self.now_ns = 0
        session: Any = SimpleNamespace(
            measured=lambda: SimpleNamespace(position=np.array([0.5, 0.25])),
            config=SimpleNamespace(robot=ROBOT),
            clock=SimpleNamespace(now_ns=lambda: self.now_ns),
            send_plan=lambda start, step, joints, rows: self.plans.append((joints, rows[0].tolist())),
        )
        self.session = session
        self._features, self._columns, self._sent = FEATURES, ROBOT.indices(FEATURES.joints), {}
        self._contract: Any = SimpleNamespace(step_ns=1)
        self._sent_ns, self._stale_ns, self.active = 0, 250_000_000, True


def test_joints_without_a_position_keep_their_last_one() -> None:
    source = Source()
    source._act({"pan.pos": 1.0})
    source._act({"lift.pos": -10.0})
    source._act({"pan.pos": 90.0})
    joints = ("pan", "lift")
    assert source.plans == [(joints, [0.1, 0.5]), (joints, [0.1, 0.0]), (joints, [2.0, 0.0])]


def test_joints_without_a_position_do_not_go_on_after_a_silence() -> None:
    source = Source()
    source._act({"pan.pos": 90.0})
    source.now_ns = 240_000_000
    source._act({"lift.pos": -10.0})
    source.now_ns += 250_000_000
    source._act({"lift.pos": -10.0})
    joints = ("pan", "lift")
    assert source.plans == [(joints, [2.0, 0.5]), (joints, [2.0, 0.0]), (joints, [0.25, 0.0])]


def test_actions_are_refused_outside_the_mode() -> None:
    source = Source()
    source.active = False
    with pytest.raises(ComponentFailed, match="its mode is not entered"):
        source._act({"pan.pos": 1.0})
    assert source.plans == []
