"""A short run of the fuzzer; `fuzz_bags.py` says what must hold of every damaged bag."""

from __future__ import annotations

import pytest

from .fuzz_bags import CONTAINERS, fuzz

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("name", CONTAINERS)
def test_damaged_bags_are_refused_or_read_as_far_as_they_are_sound(name: str) -> None:
    ended = fuzz(name, 30, seed=17)
    assert not [how for how in ended if how.startswith("wrong")]
    assert ended["refused"]
    assert sum(ended.values()) == 30
