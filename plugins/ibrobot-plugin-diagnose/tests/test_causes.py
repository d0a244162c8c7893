"""Each planted fault is named first, and healthy runs accuse nobody."""

from __future__ import annotations

from collections import Counter

import pytest
from ibrobot_diagnose.card import make_card
from ibrobot_diagnose.cause import Reference, diagnose, installed_causes
from made_runs import Run, window_of
from planted_faults import JOINTS, PICTURES, STRENGTHS, TIMES

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
    counts = Counter()
    for strength, options in zip(STRENGTHS, TIMES[cause], strict=True):
        for seed in SEEDS:
            run = Run(seed=seed, cameras=(), outcome="failure", **options)
            counts[strength] += first_of(run, Reference()) == cause
    assert counts["strong"] == len(SEEDS)
    assert min(counts["medium"], counts["mild"]) >= 2


@pytest.mark.parametrize("cause", {**PICTURES, **JOINTS})
def test_planted_fault_is_named_first_with_the_data(cause, data):
    options = {**PICTURES, **JOINTS}[cause]
    named = [
        first_of(Run(seed=9010 + number, seconds=6, outcome="failure", **each), data)
        for number, each in enumerate(options)
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
