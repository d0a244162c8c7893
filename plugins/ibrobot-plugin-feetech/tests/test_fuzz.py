"""A short run of the fuzzer: nothing but the bus's own errors comes of damaged replies."""

from __future__ import annotations

import pytest

from .fuzz import fuzz


@pytest.mark.parametrize("seed", [101, 102])
def test_damaged_replies_raise_nothing_but_the_buss_own_errors(seed: int) -> None:
    ended = fuzz(10_000, seed)
    assert ended["mutations"] >= 10_000
    assert ended["answered"] > 100
    assert ended["NoReply"] > 100
    assert ended["PortError"] > 0
