"""When the dispatcher asks: measured latency, overdue answers, failures, and an outage."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing.contexts import START_NS

from ibrobot_core.inference.client import Chunk

if TYPE_CHECKING:
    from tests.dispatch.conftest import Rig

STEP = 100_000_000
SIZE = 6


def chunk_at(index: float, length: int) -> np.ndarray:
    """Actions whose value is their time, in steps."""
    return (index + np.arange(float(length)))[:, None] * np.ones(SIZE)


def run(rig: Rig, latencies: list[int], ticks: int, length: int) -> list[int]:
    """Pass ticks; request n is answered `latencies[n % len]` ticks after it, by values that are times, or never (-1).

    Returns the ticks at which the plan was dry, once there was one.
    """
    dry = []
    for tick in range(1, ticks + 1):
        now_ns = rig.tick()
        for request in rig.requests:
            asked = rig.tick_of(request)
            if asked + latencies[(request.id - 1) % len(latencies)] == tick:
                rig.dispatcher.accept(Chunk(request.id, request.frame.stamp_ns, chunk_at(asked, length)), now_ns)
        if rig.plans and not rig.stats.plan_length:
            dry.append(tick)
    return dry


@settings(deadline=None, max_examples=40)
@given(
    latencies=st.lists(st.integers(0, 8), min_size=1, max_size=12),
    strategy=st.sampled_from(["replace", "ensemble"]),
    parallel=st.sampled_from([1, 8]),
)
def test_no_action_is_dropped_or_doubled_in_time(
    make_rig: type[Rig], latencies: list[int], strategy: str, parallel: int
) -> None:
    """Whatever the latencies, as long as they are below the chunk's length: at each time the action of that time."""
    rig = make_rig(watermark="auto", strategy=strategy, enabled=True, timeout_s=60.0, chunk_size=30)
    rig.client.parallel = parallel
    run(rig, latencies, 80, 30)
    assert rig.stats.holds == 0
    for start_ns, step_ns, positions in rig.plans:
        np.testing.assert_allclose(positions, chunk_at((start_ns - START_NS) // STEP, len(positions)), atol=1e-9)
        assert step_ns == STEP


@pytest.mark.parametrize("latency", [0, 1, 5, 8])
def test_by_the_measured_latency_it_asks_early_enough(make_rig: type[Rig], latency: int) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    assert run(rig, [latency], 200, 20) == []
    assert rig.stats.watermark >= max(10, 2 * latency)
    assert rig.stats.latency_p50_ms == rig.stats.latency_p99_ms == 100 * latency


def test_a_lost_request_is_made_up_for_before_the_plan_ends(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=30)
    assert run(rig, [3, 4, 2, -1, 4, 3], 300, 30) == []
    assert rig.stats.retries == rig.stats.requests // 6 > 2


@pytest.mark.parametrize("latencies", [[12], [12, 5, 14, 13], [14, 13, -1, 12, 6, 14, 14]])
def test_where_the_way_is_long_several_requests_are_on_it(make_rig: type[Rig], latencies: list[int]) -> None:
    """Answers that take most of a chunk's time, one lost among them: one request at a time would let the plan end."""
    alone = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    assert len(run(alone, latencies, 300, 20)) > 20
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    rig.client.parallel = 8
    assert [tick for tick in run(rig, latencies, 300, 20) if tick > 40] == []
    assert rig.stats.requests < 300 / 2
    assert rig.stats.retries == 0


def test_several_are_on_the_way_only_where_one_is_not_enough(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    rig.client.parallel = 8
    assert run(rig, [3], 100, 20) == []
    asked = [rig.tick_of(request) for request in rig.requests]
    assert np.diff(asked).min() > 3, "never before the answer"
    assert np.diff(asked)[-5:].min() >= 9, "and then as seldom as half a chunk allows"
    fixed = make_rig(watermark=5, timeout_s=60.0, chunk_size=20)
    fixed.client.parallel = 8
    run(fixed, [12], 100, 20)
    asked = [fixed.tick_of(request) for request in fixed.requests]
    assert np.diff(asked).min() >= 12, "who gives a number is asked no oftener"


def test_a_model_that_does_not_answer_at_first_is_asked_for_one_chunks_time(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    rig.client.parallel = 8
    rig.tick(100)
    assert [rig.tick_of(request) for request in rig.requests] == [1, 6, 11, 16]


def test_a_model_that_came_back_is_asked_at_once(make_rig: type[Rig]) -> None:
    rig = make_rig()
    for _ in range(30):
        rig.tick()
        if len(rig.requests) > rig.stats.failures:
            rig.dispatcher.accept(Chunk(rig.requests[-1].id, 0, None, "no server"), rig.clock.now_ns())
    asked = len(rig.requests)
    rig.tick()
    assert len(rig.requests) == asked, "the pause is long by now"
    rig.client.returns += 1
    rig.tick()
    assert len(rig.requests) == asked + 1


def test_a_fixed_watermark_below_the_latency_runs_dry(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark=2, timeout_s=60.0, chunk_size=20)
    assert run(rig, [5], 100, 20) != []
    assert rig.stats.watermark == 2


def test_an_overdue_request_is_sent_again_and_the_first_answer_is_used(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark=100, timeout_s=60.0, chunk_size=20)
    run(rig, [1], 20, 20)
    usual = len(rig.requests)
    lost = rig.requests[-1]
    rig.tick(8)
    assert rig.stats.retries >= 1
    newer = rig.requests[usual]
    assert newer.frame.stamp_ns > lost.frame.stamp_ns
    before = len(rig.plans)
    rig.answer(chunk_at(rig.tick_of(newer), 20), newer)
    assert len(rig.plans) == before + 1
    rig.answer(chunk_at(rig.tick_of(lost), 20), lost)
    assert (len(rig.plans), rig.stats.dropped_answers) == (before + 1, 1), "for older observations: of no use"


def test_an_answer_that_comes_late_after_all_is_used(make_rig: type[Rig]) -> None:
    """A model that became slower all at once: each answer is overdue, none is thrown away."""
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=30)
    assert run(rig, [1] * 10 + [14] * 50, 150, 30) == []
    assert rig.stats.retries > 0


def test_no_answer_is_overdue_before_any_latency_is_known(make_rig: type[Rig]) -> None:
    rig = make_rig(timeout_s=5.0)
    rig.tick(50)
    assert (rig.stats.requests, rig.stats.retries) == (1, 0)


def test_pauses_between_failing_requests_double_up_to_a_second(make_rig: type[Rig]) -> None:
    rig = make_rig()
    for _ in range(60):
        rig.tick()
        if len(rig.requests) > rig.stats.failures:
            rig.dispatcher.accept(Chunk(rig.requests[-1].id, 0, None, "no server"), rig.clock.now_ns())
    asked = [rig.tick_of(request) for request in rig.requests]
    assert np.diff(asked).tolist()[:6] == [1, 2, 4, 8, 10, 10]
    rig.tick(10)
    rig.answer(chunk_at(rig.tick_of(rig.requests[-1]), 10))
    failed = len(rig.requests)
    rig.tick(10)
    assert len(rig.requests) == failed + 1
    rig.dispatcher.accept(Chunk(rig.requests[-1].id, 0, None, "no server"), rig.clock.now_ns())
    rig.tick()
    assert len(rig.requests) == failed + 2, "after an answer the first pause is short again"


def test_in_an_outage_the_arm_holds_and_goes_on_from_there(make_rig: type[Rig]) -> None:
    """Three seconds without any answer, with a plan of two."""
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    run(rig, [1], 30, 20)
    end_ns, plans, requests = rig.clock.now_ns(), len(rig.plans), len(rig.requests)
    _, step_ns, positions = rig.plans[-1]
    rig.tick(30)
    assert (rig.stats.holds, rig.stats.plan_length, len(rig.plans)) == (1, 0, plans)
    asked = [request.frame.stamp_ns for request in rig.requests[requests:]]
    assert np.diff([end_ns, *asked, rig.clock.now_ns()]).max() <= 10**9 + 5 * STEP, "it goes on asking"
    rig.answer(chunk_at(100.0, 20))
    begin_ns, _, resumed = rig.plans[-1]
    assert begin_ns <= rig.clock.now_ns() < begin_ns + step_ns
    np.testing.assert_array_equal(resumed[0], positions[-1])
    assert rig.stats.holds == 1


@pytest.mark.parametrize(("safety_behavior", "prefix"), [("hold", [2.0]), ("relax", None)])
def test_only_where_the_arm_is_held_it_goes_on_from_there(
    make_rig: type[Rig], safety_behavior: str, prefix: list[float] | None
) -> None:
    rig = make_rig(strategy="rtc", safety_behavior=safety_behavior, timeout_s=0.3)
    rig.tick()
    rig.answer(chunk_at(0.0, 3))
    rig.tick(6)
    first, planned, dry = rig.requests
    assert first.frame.prefix is None
    assert planned.frame.prefix is not None
    assert (None if dry.frame.prefix is None else dry.frame.prefix[:, 0].tolist()) == prefix
    rig.answer(chunk_at(101.0, 10), dry)
    past = (rig.clock.now_ns() - dry.frame.stamp_ns) // STEP
    assert rig.plans[-1][2][0, 0] == (2.0 if safety_behavior == "hold" else 101.0 + past)


def test_waiting_for_other_robots_does_not_raise_the_demand(make_rig: type[Rig]) -> None:
    """Who asks earlier because the server is busy makes it busier."""
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    for _ in range(5):
        while len(rig.requests) <= rig.stats.chunks:
            rig.tick()
        asked_ns = rig.tick(7) - 7 * STEP
        rig.answer(chunk_at((asked_ns - START_NS) // STEP, 20), queued_ns=6 * STEP)
        assert rig.stats.latency_ms == 700.0
        assert rig.stats.queue_ms == 600.0
    rig.tick()
    assert rig.stats.watermark <= 20 // 2


def test_one_that_had_to_wait_for_others_asks_later_by_as_much(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    asked: list[int] = []
    queued = (0, 2, 0)
    for ticks in queued:
        while len(rig.requests) == len(asked):
            rig.tick()
        asked.append(rig.tick_of(rig.requests[-1]))
        rig.tick(ticks)
        rig.answer(chunk_at(asked[-1], 20), queued_ns=ticks * STEP)
    assert np.diff(asked).tolist() == [9, 11]


def test_the_servers_pace_is_kept_as_long_as_the_plan_lasts(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    for pace, expected in ((0, 9), (14, 14), (40, 17)):
        rig.tick()
        while rig.stats.requests == rig.stats.chunks:
            rig.tick()
        asked = rig.tick_of(rig.requests[-1])
        rig.answer(chunk_at(asked, 20), pace_ns=pace * STEP)
        while rig.stats.requests == rig.stats.chunks:
            rig.tick()
        assert rig.tick_of(rig.requests[-1]) - asked == expected
        assert rig.stats.pace_ms == 100 * pace
        rig.answer(chunk_at(rig.tick_of(rig.requests[-1]), 20))
    assert rig.stats.holds == 0


def test_who_gives_a_watermark_is_not_paced(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark=15, timeout_s=60.0, chunk_size=20)
    rig.tick()
    rig.answer(chunk_at(0, 20), pace_ns=40 * STEP)
    rig.tick(4)
    assert len(rig.requests) == 2


def test_all_requests_in_flight_in_an_outage_are_one_failure(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=3.0, chunk_size=20)
    rig.client.parallel = 8
    rig.tick(20)
    assert len(rig.requests) == 4
    for request in reversed(rig.requests):
        rig.dispatcher.accept(Chunk(request.id, 0, None, "no server"), rig.clock.now_ns())
    assert (rig.stats.failures, rig.stats.dropped_answers) == (1, 0)
    rig.tick(2)
    rig.dispatcher.accept(Chunk(rig.requests[-1].id, 0, None, "no server"), rig.clock.now_ns())
    assert rig.stats.failures == 2, "one that was sent after the first was known"


def test_requests_that_time_out_one_after_the_other_are_one_failure(make_rig: type[Rig]) -> None:
    rig = make_rig(watermark="auto", timeout_s=3.0, chunk_size=20)
    rig.client.parallel = 8
    rig.tick(47)
    assert rig.stats.timeouts == 4
    assert rig.stats.failures == 1


def test_a_request_that_a_newer_one_follows_does_not_count_as_failure(make_rig: type[Rig]) -> None:
    """As a server turns it away when the newer one comes."""
    rig = make_rig(watermark="auto", timeout_s=60.0, chunk_size=20)
    rig.client.parallel = 8
    rig.tick(6)
    older, newer = rig.requests
    rig.dispatcher.accept(Chunk(older.id, 0, None, "a newer one took its place"), rig.clock.now_ns())
    assert rig.stats.failures == 0
    rig.answer(chunk_at(rig.tick_of(newer), 20), newer)
    assert (rig.stats.chunks, rig.stats.failures) == (1, 0)
