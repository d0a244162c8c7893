"""Episodes of a dataset: each planted fault is listed, and good episodes are not."""

from __future__ import annotations

import itertools
from collections import Counter
from functools import cache
from pathlib import Path

import attrs
import numpy as np
import pytest
from ibrobot_diagnose.card import Maker, make_card
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.commands import check
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.testing import make_window
from made_runs import Run, window_of
from planted_faults import DEMONSTRATED


def demo(**options):
    options = {"seed": 50, "seconds": 7.0} | options
    return window_of(Run(acts=False, **options), f"demo_{options['seed']}")


@cache
def good(seed):
    return demo(seed=seed, seconds=6.6 + 0.1 * (seed % 5))


@pytest.fixture(scope="module")
def others() -> Reference:
    """Ten good episodes."""
    whole = Maker()
    for seed in range(10):
        maker = Maker()
        maker.add(good(seed))
        whole.join(maker)
    return Reference(whole.card())


@pytest.mark.parametrize("cause", DEMONSTRATED)
def test_planted_fault_is_named(cause, others):
    named = [each.name for each in diagnose(demo(**DEMONSTRATED[cause]), others).findings]
    assert cause in named[:1] or (cause in named[:2] and named[0] in {"odd_length"}), named


def test_good_episodes_are_not_listed(others):
    named = Counter(name for seed in range(60, 63) for name in [diagnose(demo(seed=seed), others).first])
    assert named == {"": 3}


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_start_beside_those_of_a_few_episodes_is_usual(count):
    """Of starts that are spread evenly, many lie outside of the few others."""
    runs = [
        {"seed": seed, "cameras": (), "start": (0.0, 0.3 * (seed * 7 % 10) / 10, 0.0, 0.0)} for seed in range(count)
    ]
    reference = Reference(make_card(demo(**each) for each in runs))
    named = Counter(
        diagnose(demo(seed=70 + i, cameras=(), start=(0.0, i / 10, 0.0, 0.0)), reference).first for i in (-1, 4)
    )
    assert named["unseen_start"] == 0


def test_start_far_from_those_of_a_few_episodes_is_named():
    reference = Reference(
        make_card(demo(seed=seed, cameras=(), start=(0.0, 0.02 * seed, 0.0, 0.0)) for seed in range(4))
    )
    assert diagnose(demo(seed=70, cameras=(), start=(0.0, 0.9, 0.0, 0.0)), reference).first == "unseen_start"


def test_run_beside_the_starts_of_a_few_demonstrations_is_named():
    """An episode may begin there, but a policy has not seen it."""
    reference = Reference(
        make_card(demo(seed=seed, cameras=(), start=(0.0, 0.1 * seed, 0.0, 0.0)) for seed in range(3))
    )
    run = window_of(Run(seed=70, seconds=5, cameras=(), start=(0.0, 0.6, 0.0, 0.0), outcome="failure"))
    assert diagnose(run, reference).first == "unseen_start"


def test_task_is_usual_where_each_episode_has_its_own():
    reference = Reference(make_card(demo(seed=seed, cameras=(), prompt=f"sort shelf {seed}") for seed in range(4)))
    assert diagnose(demo(seed=70, cameras=(), prompt="sort shelf 9"), reference).first == ""


@pytest.mark.parametrize(
    ("cause", "options"), [("idle_start", {"idle_s": 3.0, "seconds": 9.5}), ("idle_end", {"seconds": 12.0})]
)
def test_episode_of_a_dataset_in_which_a_policy_acted_is_a_demonstration(cause, options, others, monkeypatch):
    run = window_of(Run(seed=50, cameras=(), **options))
    assert run.asked
    monkeypatch.setattr(check, "read_episode", lambda path: run)
    named = [each["name"] for each in check.check_episode((Path("episode"), others.card)).causes]
    assert named[0] == cause
    assert cause not in {each.name for each in diagnose(run, others).findings}, "a run that is explained is none"


@pytest.mark.parametrize("lasts_s", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("bound", [9.0, 0.6])
def test_joint_that_stands_while_others_move_is_cut_off_only_if_they_go_on(lasts_s, bound):
    """A planned motion stops at each of its goals, and leaves a joint where a goal does not name it."""
    goals = [(0.0, 0.0), (0.8, 0.5), (0.8, -0.5), (0.8, 0.2), (0.0, 0.0)]
    ramp = 0.5 - 0.5 * np.cos(np.pi * np.arange(round(30 * lasts_s)) / round(30 * lasts_s))
    parts = [np.outer(1 - ramp, one) + np.outer(ramp, other) for one, other in itertools.pairwise(goals)]
    commands = np.minimum(np.concatenate(parts), (bound, 9.0))
    accused = "saturated" in {each.name for each in diagnose(make_window(commands), Reference()).findings}
    assert accused == (bound < 1)


@pytest.mark.parametrize(("eases", "accused"), [(True, False), (False, True)])
def test_joint_that_slows_down_before_it_stands_at_its_end_is_not_cut_off(eases, accused):
    """While another joint goes on, so that the pace of the motion says nothing of it."""
    at = np.clip(np.arange(120) / 40, 0.0, 1.0)
    turned = 0.8 * (np.sin(np.pi * at / 2) if eases else at)
    commands = np.column_stack([turned, 0.02 * np.arange(120)])
    named = {each.name for each in diagnose(make_window(commands), Reference()).findings}
    assert ("saturated" in named) == accused


@pytest.mark.parametrize(("name", "accused"), [("elbow", True), ("gripper", False), ("kLeftHandPinky", False)])
def test_joint_that_holds_something_stands_at_its_end(name, accused):
    at = np.clip(np.arange(120) / 40, 0.0, 1.0)
    commands = np.column_stack([0.02 * np.arange(120), 0.8 * at])
    window = make_window(commands, joints=("pan", name))
    assert ("saturated" in {each.name for each in diagnose(window, Reference()).findings}) == accused


def test_later_copy_is_named_with_the_episode_that_it_copies(others):
    """Also in the part of the dataset with which an episode is not compared otherwise; the earlier one is kept."""
    seeds = (1, 2, None, 3, 4, 5, 1, 2, 1)  # None: an episode that cannot be used
    makers = []
    for seed in seeds:
        makers.append(Maker())
        if seed is not None:
            makers[-1].add(good(seed))
    named = {}
    for number, near in enumerate(check.nearest_earlier(makers)):
        if near is not None:
            card = attrs.evolve(others.card, ways=makers[near].ways[0], way_names=(f"episode_{near}",))
            findings = diagnose(good(seeds[number]), Reference(card)).findings
            texts = [each.evidence.text for each in findings if each.name == "duplicate"]
            if texts:
                named[number] = texts[0].partition(",")[0]
    assert named == {
        6: "The arm moves as in episode_0", 7: "The arm moves as in episode_1", 8: "The arm moves as in episode_0"
    }  # fmt: skip


def test_ways_of_no_episodes_and_of_robots_with_other_joints_are_not_compared():
    assert check.nearest_earlier([]) == []
    moved = 0.02 * np.arange(120)[:, None]
    makers = [Maker() for _ in range(5)]
    assert check.nearest_earlier(makers) == [None] * 5
    for maker, joints in zip(makers, (2, 3, 3, 1, 2), strict=True):
        maker.add(make_window(np.repeat(moved, joints, axis=1)))
    assert check.nearest_earlier(makers) == [None, None, 1, None, 0]
