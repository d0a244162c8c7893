"""Each planted fault is named first, and healthy runs accuse nobody."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from ibrobot_diagnose.card import make_card
from ibrobot_diagnose.cause import KIND, Cause, CauseDescriptor, Evidence, Reference, diagnose, installed_causes
from made_runs import Run, window_of
from planted_faults import JOINTS, PICTURES, STRENGTHS, TIMES

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Registry

SEEDS = range(9000, 9003)
"""Seeds on which no threshold was chosen."""


@pytest.fixture(scope="module")
def data() -> Reference:
    """Ten demonstrations."""
    return Reference(make_card(window_of(Run(seed=each, acts=False, seconds=7), f"demo_{each}") for each in range(10)))


def first_of(run: Run, reference: Reference) -> str:
    return diagnose(window_of(run), reference).first


@pytest.mark.parametrize("cause", TIMES)
def test_planted_fault_is_named_first(cause):
    counts = Counter[str]()
    for strength, options in zip(STRENGTHS, TIMES[cause], strict=True):
        for seed in SEEDS:
            run = Run(seed=seed, cameras=(), outcome="failure", **options)
            counts[strength] += first_of(run, Reference()) == cause
    assert counts["strong"] == len(SEEDS)
    assert min(counts["medium"], counts["mild"]) >= 2


@pytest.mark.parametrize("cause", [*PICTURES, *JOINTS])
def test_planted_fault_is_named_first_with_the_data(cause, data):
    planted: dict[str, tuple[dict[str, Any], ...]] = PICTURES | JOINTS
    named = [
        first_of(Run(seed=9010 + number, seconds=6, outcome="failure", **each), data)
        for number, each in enumerate(planted[cause])
    ]
    assert named[1:] == [cause] * 2
    assert named[0] in (cause, ""), "a mild fault may be missed, but accuses no other cause"


def test_healthy_runs_accuse_nobody():
    runs = [Run(seed=seed, cameras=(), latency_s=0.02 + 0.003 * (seed % 50)) for seed in range(9100, 9140)]
    assert Counter(first_of(run, Reference()) for run in runs) == {"": 40}


@pytest.mark.parametrize("outcome", ["success", "failure"])
def test_healthy_runs_accuse_nobody_with_the_data(outcome, data):
    runs = [Run(seed=seed, seconds=6, drift=0.01, outcome=outcome) for seed in range(9200, 9206)]
    assert Counter(first_of(run, data) for run in runs) == {"": 6}


def test_each_cause_says_what_to_do():
    for cause in installed_causes():
        assert cause.remedy.endswith("."), cause.name
        assert cause.title[0].islower(), cause.name
        assert cause.explains <= {each.name for each in installed_causes()} | {"camera_ignored"}, cause.name


def test_gripper_that_holds_something_is_no_fault():
    held = window_of(Run(seed=9300, cameras=(), gain={3: 0.6}))
    assert diagnose(held, Reference()).first == ""


def test_gripper_that_never_moves_is_one():
    shut = window_of(Run(seed=9301, cameras=(), slack={3: 5.0}))
    first = diagnose(shut, Reference()).findings[0]
    assert (first.name, "gripper" in first.evidence.text) == ("arm_not_following", True)


def test_of_two_causes_the_one_that_explains_the_other_comes_first():
    slow = diagnose(window_of(Run(seed=9302, cameras=(), latency_s=0.8)), Reference())
    assert [each.name for each in slow.findings][:2] == ["answers_slow", "plan_dry"]
    assert slow.findings[0].evidence.likelihood < slow.findings[1].evidence.likelihood


class Squeaks(Cause):
    """A cause of another package."""

    name, title, remedy = "squeaks", "no joint squeaks", "Oil it."

    def test(self, window, reference):
        return Evidence("A joint squeaks.", 1.0, "joints", 0.5, 0.9)


def test_other_packages_add_causes(monkeypatch):
    offered = CauseDescriptor(type="squeaks", make=Squeaks, summary="a joint squeaks")
    monkeypatch.setattr(Registry, "of_kind", lambda self, kind: [offered] * (kind == KIND))
    assert diagnose(window_of(Run(cameras=())), Reference()).first == "squeaks"
    monkeypatch.setattr(Squeaks, "name", "plan_dry")
    with pytest.raises(IbrobotError, match="there is a cause 'plan_dry' already"):
        installed_causes()
