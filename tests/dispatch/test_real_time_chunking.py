"""Real-time chunking: what a request says of the plan, and that a policy which continues it leaves no seam."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing import make_robot
from ibrobot_testing.contexts import START_NS

from ibrobot_core.errors import ContractError
from ibrobot_core.inference.client import Chunk, DispatchInfer

if TYPE_CHECKING:
    from tests.dispatch.conftest import Rig

STEP = 100_000_000
SIZE, LENGTH = 6, 16
STRIDE = 0.02
"""The largest step of the random walks that stand for chunks [rad]."""


def continued(request: DispatchInfer, honoured: int, rng: np.random.Generator) -> np.ndarray:
    """A chunk that follows so many actions of the prefix and goes on as a random walk; without one, from anywhere."""
    prefix = request.frame.prefix
    kept = np.empty((0, SIZE)) if prefix is None else prefix[:honoured]
    start = kept[-1] if len(kept) else rng.uniform(-1, 1, SIZE)
    walk = start + np.cumsum(rng.uniform(-STRIDE, STRIDE, (LENGTH - len(kept), SIZE)), axis=0)
    return np.concatenate((kept, walk))


def setpoints(rig: Rig, ticks: int) -> np.ndarray:
    """The arm's setpoint at each tick from the first plan on: the newest plan's action, its last one once it ended."""
    commanded, newest = [], None
    plans = iter(rig.sent)
    coming = next(plans, None)
    for tick in range(1, ticks + 1):
        while coming is not None and coming[0] <= tick:
            newest, coming = coming, next(plans, None)
        if newest is not None:
            _, (start_ns, step_ns, positions) = newest
            commanded.append(positions[min((START_NS + tick * STEP - start_ns) // step_ns, len(positions) - 1)])
    return np.array(commanded)


def run(rig: Rig, latencies: list[int], ticks: int, honoured: int | None, seed: int) -> None:
    """As many ticks; request n is answered `latencies[n % len]` ticks after it; `honoured` None: what was asked for."""
    rng = np.random.default_rng(seed)
    for tick in range(1, ticks + 1):
        now_ns = rig.tick()
        for request in rig.requests:
            if rig.tick_of(request) + latencies[(request.id - 1) % len(latencies)] == tick:
                count = request.frame.delay_steps if honoured is None else honoured
                rig.dispatcher.accept(Chunk(request.id, request.frame.stamp_ns, continued(request, count, rng)), now_ns)


@settings(deadline=None, max_examples=60)
@given(latencies=st.lists(st.integers(0, 6), min_size=1, max_size=8), seed=st.integers(0, 999))
def test_a_policy_that_continues_the_plan_leaves_no_seam(make_rig: type[Rig], latencies: list[int], seed: int) -> None:
    """Whatever the latency, no step is longer than those within the chunks."""
    rig = make_rig(watermark="auto", strategy="rtc", timeout_s=60.0, chunk_size=LENGTH)
    run(rig, latencies, 60, LENGTH - 1, seed)
    assert rig.stats.holds == 0
    steps = np.abs(np.diff(setpoints(rig, 60), axis=0))
    # A request sent since the one before was overdue knows nothing of the answer to that: what it misses is led over.
    led_over = 0.5 * make_robot().max_velocity * STEP * 1e-9 if rig.stats.retries else np.zeros(SIZE)
    assert (steps <= STRIDE + led_over + 1e-12).all()
    assert np.count_nonzero(steps.any(axis=1)) > 40, "and it moves"


@pytest.mark.parametrize("latency", [1, 4, 6])
def test_continuing_it_for_the_expected_latency_is_enough_where_that_is_steady(
    make_rig: type[Rig], latency: int
) -> None:
    rig = make_rig(watermark="auto", strategy="rtc", timeout_s=60.0, chunk_size=LENGTH)
    run(rig, [latency], 200, None, 5)
    assert np.abs(np.diff(setpoints(rig, 200), axis=0)).max() <= STRIDE + 1e-12


@pytest.mark.parametrize("strategy", ["replace", "ensemble"])
def test_the_same_policy_without_a_prefix_jumps(make_rig: type[Rig], strategy: str) -> None:
    rig = make_rig(watermark="auto", strategy=strategy, enabled=True, timeout_s=60.0, chunk_size=LENGTH)
    run(rig, [4], 100, None, 5)
    assert {(request.frame.prefix, request.frame.delay_steps) for request in rig.requests} == {(None, 0)}
    assert np.abs(np.diff(setpoints(rig, 100), axis=0)).max() > 5 * STRIDE


def test_a_request_carries_the_rest_of_the_plan_and_the_expected_latency(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark=4, strategy="rtc", timeout_s=60.0)
    rig.tick()
    assert (rig.requests[0].frame.prefix, rig.requests[0].frame.delay_steps) == (None, 0)
    rig.tick()
    plan = np.random.default_rng(1).uniform(-1, 1, (10, SIZE))
    rig.answer(plan)
    rig.tick(4)
    frame = rig.requests[1].frame
    assert rig.tick_of(rig.requests[1]) == 6
    np.testing.assert_array_equal(frame.prefix, plan[5:], "the action of this very tick is the first")
    assert frame.delay_steps == 3, "three times the only latency known: one tick"


def test_no_more_than_a_chunk_of_the_plan_is_sent(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark=100, strategy="rtc", timeout_s=60.0, chunk_size=5)
    rig.tick()
    rig.answer(np.zeros((9, SIZE)))
    rig.tick()
    prefix = rig.requests[1].frame.prefix
    assert prefix is not None
    assert prefix.shape == (5, SIZE)


def test_while_the_arm_is_held_the_prefix_is_where_and_for_how_long(make_rig: type[Rig]) -> None:
    rig = make_rig(strategy="rtc", timeout_s=1.0)
    rig.tick(5)
    rig.answer(np.ones((6, SIZE)) * np.arange(6.0)[:, None])
    rig.tick(13)
    frame = rig.requests[-1].frame
    assert rig.stats.timeouts == 1
    np.testing.assert_array_equal(frame.prefix, np.full((5, SIZE), 5.0), "half of a chunk, however slow the model is")
    assert frame.delay_steps == 5


def test_a_policy_that_cannot_continue_a_plan_is_refused(make_rig: type[Rig]) -> None:
    with pytest.raises(ContractError, match="strategy: rtc needs a policy that continues the plan"):
        make_rig(strategy="rtc", prefix=False)


def test_a_lead_in_bridges_the_gap_between_plan_and_chunk(make_rig: type[Rig]) -> None:
    """A policy continues the plan about, as guided flows do."""
    rig = make_rig(watermark=9, strategy="rtc", timeout_s=60.0)
    rig.tick()
    planned = np.linspace(0.0, 0.5, 10)[:, None] * np.ones(SIZE)
    rig.answer(planned)
    rig.tick(3)
    rig.answer(planned[1:] + 0.01)
    start_ns, _, positions = rig.plans[-1]
    assert start_ns == rig.clock.now_ns()
    np.testing.assert_allclose(positions[0], planned[3], atol=1e-12)
    np.testing.assert_allclose(positions[-1], planned[-1] + 0.01, atol=1e-12)
    assert np.diff(positions, axis=0).max() < np.diff(planned, axis=0).max() + 0.01
