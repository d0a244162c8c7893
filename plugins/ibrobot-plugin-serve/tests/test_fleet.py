"""Many dispatchers on one model, in stepped time: `watermark: auto` does as well as the best fixed watermark."""

from __future__ import annotations

import pytest
from stepped_fleet import CHUNK, SETTLED_S, Fleet, worse


@pytest.fixture(scope="module")
def fixed() -> Fleet:
    return Fleet(30, CHUNK // 2, 32.0, 2.0)


@pytest.fixture(scope="module")
def auto() -> Fleet:
    return Fleet(30, "auto", 32.0, 2.0)


def test_thirty_robots_share_a_model_as_with_the_best_fixed_watermark(fixed: Fleet, auto: Fleet):
    """Of `benchmarks/stepped_fleet.py`, which tries them all."""
    phase = auto.phases()["before"]
    assert worse(phase, fixed.phases()["before"]) == []
    assert phase["holds"] == 0
    assert phase["load"] < 0.8


def test_robots_that_start_together_spread_over_time(fixed: Fleet, auto: Fleet):
    assert fixed.phases()["before"]["p99_ms"] > 300, "those with a fixed watermark wait for each other for ever"
    assert auto.phases()["before"]["p99_ms"] < 60


def test_a_model_that_stood_still_for_two_seconds_is_as_before_five_seconds_later(fixed: Fleet, auto: Fleet):
    phases = auto.phases()
    assert worse(phases["after"], fixed.phases()["after"]) == []
    assert worse(phases["after"], {**phases["before"], "p99_ms": 60.0}) == []
    resumed_s = auto.hiccup.stop / 1e9
    assert auto.measure(resumed_s + 1.0, resumed_s + SETTLED_S)["holds"] == 0
    assert phases["hiccup"]["holds"] == 30, "each arm held once, while the model stood still"


def test_more_robots_than_the_model_can_serve_at_half_a_chunk_ask_less_often():
    phase = Fleet(45, "auto", 20.0).measure(SETTLED_S, 20.0)
    assert phase["load"] < 0.85
    assert phase["p99_ms"] < 100
    assert phase["holds"] == 0
