"""The estimate of latency against numpy's quantiles, and what it makes of few answers and of one that was held up."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.dispatch.latency import LatencyEstimate

MS = 1_000_000


def estimate(latencies: list[int], spacing_ns: int = 0) -> LatencyEstimate:
    """Answers with these latencies, one every `spacing_ns` [ns]."""
    result = LatencyEstimate()
    for number, latency_ns in enumerate(latencies):
        result.add(number * spacing_ns, latency_ns)
    return result


@given(latencies=st.lists(st.integers(0, 10**10), min_size=1, max_size=250), share=st.floats(0, 1))
def test_quantiles_are_those_of_the_newest_hundred(latencies: list[int], share: float) -> None:
    expected = np.quantile(latencies[-100:], share)
    assert estimate(latencies).quantile_ns(share) == pytest.approx(expected, abs=1, rel=1e-9)


def test_nothing_is_known_before_the_first_answer() -> None:
    assert estimate([]).quantile_ns(0.5) == estimate([]).upper_ns == 0


@pytest.mark.parametrize(("answers", "factor"), [(1, 3.0), (2, 2.0), (4, 1.5), (100, 1.02)])
def test_the_fewer_answers_the_more_is_allowed_for(answers: int, factor: float) -> None:
    assert estimate([200 * MS] * answers).upper_ns == pytest.approx(factor * 200 * MS)


def test_it_covers_a_spread_of_half_from_the_second_answer_on() -> None:
    latencies = (np.random.default_rng(3).uniform(0.5, 1.5, 500) * 800 * MS).astype(int).tolist()
    for count in range(2, 500):
        assert estimate(latencies[:count]).upper_ns >= 0.97 * latencies[count]


def test_one_answer_that_was_held_up_does_not_count() -> None:
    usual = [50 * MS] * 99
    assert estimate([*usual, 3000 * MS]).upper_ns < 60 * MS
    assert estimate([*usual[:80], *[900 * MS] * 5]).upper_ns > 900 * MS, "several do"


def test_answers_expire_by_time() -> None:
    hiccup, usual = [2000 * MS] * 3, [50 * MS] * 12
    assert estimate([*hiccup, *usual], 800 * MS).quantile_ns(1.0) == 2000 * MS, "it was 9.6 s ago"
    assert estimate([*hiccup, *usual, 50 * MS], 800 * MS).quantile_ns(1.0) == 50 * MS, "10.4 s"
    assert estimate([70 * MS, 90 * MS], 60_000 * MS).quantile_ns(0.0) == 90 * MS, "the newest always counts"
