"""How punctuality is counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.control.timing import Punctuality

PERIOD_NS = 10_000_000


def test_nothing_was_counted_yet() -> None:
    assert Punctuality().summary() == {
        "ticks": 0,
        "rate_hz": 0.0,
        "lateness_p50_us": 0,
        "lateness_p99_us": 0,
        "missed": 0,
    }


@given(late_us=st.lists(st.integers(0, 19_999), min_size=2, max_size=300))
def test_percentiles_are_those_of_the_ticks(late_us: list[int]) -> None:
    punctuality = Punctuality()
    for index, late in enumerate(late_us):
        punctuality.tick(index * PERIOD_NS, late * 1000 + 999, 0)
    summary = punctuality.summary()

    assert summary["lateness_p50_us"] == np.percentile(late_us, 50, method="inverted_cdf")
    assert summary["lateness_p99_us"] == np.percentile(late_us, 99, method="inverted_cdf")
    assert summary["ticks"] == len(late_us)
    assert summary["rate_hz"] == pytest.approx(100.0)


def test_missed_ticks_lower_the_rate_and_are_counted() -> None:
    punctuality = Punctuality()
    punctuality.tick(0, 0, 0)
    punctuality.tick(4 * PERIOD_NS, 0, 3)

    assert punctuality.summary()["missed"] == 3
    assert punctuality.summary()["rate_hz"] == 25.0


def test_later_than_can_be_distinguished_counts_as_latest_and_early_as_punctual() -> None:
    punctuality = Punctuality()
    for index, late_ns in enumerate((-5_000, 10**12)):
        punctuality.tick(index * PERIOD_NS, late_ns, 0)

    assert punctuality.summary()["lateness_p50_us"] == 0
    assert punctuality.summary()["lateness_p99_us"] == 20_000
