"""Episodes of a dataset: each planted fault is listed, and good episodes are not."""

from __future__ import annotations

from collections import Counter

import pytest
from ibrobot_diagnose.card import Maker, make_card
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


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_start_beside_those_of_a_few_episodes_is_usual(count):
    """Of starts that are spread evenly, many lie outside of the few others."""
    runs = [{"seed": seed, "start": (0.0, 0.3 * (seed * 7 % 10) / 10, 0.0, 0.0)} for seed in range(count)]
    reference = Reference(make_card(demo(**each) for each in runs))
    named = Counter(diagnose(demo(seed=70 + i, start=(0.0, i / 10, 0.0, 0.0)), reference).first for i in (-1, 4))
    assert named["unseen_start"] == 0


def test_start_far_from_those_of_a_few_episodes_is_named():
    reference = Reference(make_card(demo(seed=seed, start=(0.0, 0.02 * seed, 0.0, 0.0)) for seed in range(4)))
    assert diagnose(demo(seed=70, start=(0.0, 0.9, 0.0, 0.0)), reference).first == "unseen_start"


def test_run_beside_the_starts_of_a_few_demonstrations_is_named():
    """An episode may begin there, but a policy has not seen it."""
    reference = Reference(make_card(demo(seed=seed, start=(0.0, 0.1 * seed, 0.0, 0.0)) for seed in range(3)))
    run = window_of(Run(seed=70, seconds=5, cameras=(), start=(0.0, 0.6, 0.0, 0.0), outcome="failure"))
    assert diagnose(run, reference).first == "unseen_start"


def test_task_is_usual_where_each_episode_has_its_own():
    reference = Reference(make_card(demo(seed=seed, prompt=f"sort shelf {seed}") for seed in range(4)))
    assert diagnose(demo(seed=70, prompt="sort shelf 9"), reference).first == ""
