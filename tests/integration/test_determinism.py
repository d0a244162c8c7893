"""Equal seeds, equal runs: bit by bit, in lockstep, in this process and in others."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.integration.conftest import Log, Ran

pytestmark = pytest.mark.integration


def test_equal_seeds_give_equal_trajectories_and_others_do_not(recorded: Callable[..., tuple[Ran, list[Log]]]):
    (_, first), (_, second) = (
        recorded("--lockstep", "--episodes", "2", "--seed", "3", dataset=name, child=name == "second")
        for name in ("first", "second")
    )
    assert [log.text for log in first] == [log.text for log in second]
    shortest = min(len(log.times) for log in first)
    assert not np.array_equal(first[0].positions[:shortest], first[1].positions[:shortest])
    _, (later,) = recorded("--lockstep", "--episodes", "1", "--seed", "4", dataset="later")
    assert np.array_equal(later.positions, first[1].positions), "a seed's episode does not depend on those before it"


def test_noise_and_latency_are_seeded_too(recorded: Callable[..., tuple[Ran, list[Log]]]):
    rough = ("--set", "simulation.noise=0.002", "--set", "simulation.latency=0.02", "--duration", "2", "--lockstep")
    (_, (first,)), (_, (second,)), (_, (other,)) = (
        recorded(*rough, "--seed", seed, dataset=name, child=name == "b")
        for name, seed in (("a", "3"), ("b", "3"), ("c", "4"))
    )
    assert first.text == second.text
    assert first.text != other.text
