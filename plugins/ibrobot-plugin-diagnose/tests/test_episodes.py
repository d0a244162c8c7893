"""Episodes of a dataset: each planted fault is listed, and good episodes are not."""

from __future__ import annotations

from collections import Counter

import pytest
from ibrobot_diagnose.card import Maker
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.diagnosis import diagnose
from made_runs import Run, window_of
from planted_faults import DEMONSTRATED


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


@pytest.mark.parametrize("cause", DEMONSTRATED)
def test_planted_fault_is_named(cause, others):
    named = [each.name for each in diagnose(demo(**DEMONSTRATED[cause]), others).findings]
    assert cause in named[:1] or (cause in named[:2] and named[0] in {"odd_length"}), named


def test_good_episodes_are_not_listed(others):
    named = Counter(name for seed in range(60, 66) for name in [diagnose(demo(seed=seed), others).first])
    assert named == {"": 6}
