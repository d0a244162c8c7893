"""Episodes of a dataset: each planted fault is listed, and good episodes are not."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from ibrobot_diagnose.card import Maker
from ibrobot_diagnose.cause import Reference, diagnose
from made_runs import Run, window_of
from planted_faults import frozen, of_top, scaled

PLANTED: dict[str, Any] = {
    "idle_start": {"idle_s": 3.0, "seconds": 9.5},
    "idle_end": {"seconds": 12.0},
    "stall": {"stall": (2.5, 3.0), "seconds": 10.0},
    "jerk": {"shake": 0.05},
    "saturated": {"seen": lambda state: np.minimum(state, (0.3, 9, 9, 9)), "cut": (0, 0.3)},
    "picture_black": {"picture": lambda camera, picture, t_s: picture * (not 2 < t_s < 3)},
    "picture_frozen": {"picture": frozen(3.0)},
    "picture_dark": {"picture": scaled(0.4)},
    "picture_gaps": {"blind": (2.0, 3.5)},
    "gripper_idle": {"shut": True},
    "arm_not_following": {"gain": {0: 0.4}},
    "camera_moved": {"moved": {"top": (5, 2, 0.03)}},
    "unseen_start": {"start": (0, 0.5, 0, 0)},
    "other_prompt": {"prompt": "wipe the table"},
    "other_speed": {"speed": 2.6, "seconds": 4.0},
    "bgr": {"picture": of_top(lambda picture: picture[..., ::-1])},
    "duplicate": {"seed": 3, "seconds": 6.9},
    "not_judged": {"outcome": "unknown"},
}


def demo(**options):
    options = {"seed": 50, "seconds": 7.0} | options
    return window_of(Run(acts=False, **options), f"demo_{options['seed']}")


@pytest.fixture(scope="module")
def others() -> Reference:
    """Ten good episodes."""
    whole = Maker()
    for seed in range(10):
        maker = Maker()
        maker.add(demo(seed=seed, seconds=6.6 + 0.1 * (seed % 5)))
        whole.join(maker)
    return Reference(whole.card())


@pytest.mark.parametrize("cause", PLANTED)
def test_planted_fault_is_named(cause, others):
    named = [each.name for each in diagnose(demo(**PLANTED[cause]), others).findings]
    assert cause in named[:1] or (cause in named[:2] and named[0] in {"odd_length"}), named


def test_good_episodes_are_not_listed(others):
    named = Counter(name for seed in range(60, 66) for name in [diagnose(demo(seed=seed), others).first])
    assert named == {"": 6}
