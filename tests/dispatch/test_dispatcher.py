"""The dispatcher on a stepped clock: when it asks, what it does with answers that are late, early, wrong or missing."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np
import pytest
from ibrobot_testing import host_context
from ibrobot_testing.contexts import START_NS
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.inference.client import LockstepClient

if TYPE_CHECKING:
    from tests.dispatch.conftest import Rig

STEP = 100_000_000
"""The contract's tick at 10 Hz [ns]."""
SIZE = 6


def ramp(length: int, first: float = 0.0) -> np.ndarray:
    return (first + np.arange(float(length)))[:, None] * np.ones(SIZE)


def test_asks_at_once_with_the_stamped_observation_and_the_prompt(make_rig: type[Rig]):
    rig = make_rig()
    t_ns = rig.tick()
    (request,) = rig.requests
    assert request.frame.stamp_ns == t_ns
    assert request.frame.prompt == "pick the cube"
    np.testing.assert_array_equal(request.frame.values["observation.state"], np.ones(SIZE, np.float32))
    assert rig.client.seeds == [7]


def test_one_request_is_in_flight_at_a_time(make_rig: type[Rig]):
    rig = make_rig(timeout_s=60.0)
    rig.tick(20)
    assert rig.stats.requests == len(rig.requests) == 1


def test_asks_again_when_no_more_than_the_watermark_remains(make_rig: type[Rig]):
    rig = make_rig(watermark=3)
    rig.tick()
    rig.answer(ramp(10))
    asked = {}
    for _ in range(8):
        rig.tick()
        asked[rig.stats.plan_length] = len(rig.requests)
    assert asked == {8: 1, 7: 1, 6: 1, 5: 1, 4: 1, 3: 2, 2: 2, 1: 2}


def test_sends_the_plan_at_the_observations_time(make_rig: type[Rig]):
    rig = make_rig()
    t_ns = rig.tick()
    rig.answer(ramp(10))
    ((start_ns, step_ns, positions),) = rig.plans
    assert (start_ns, step_ns) == (t_ns, STEP)
    np.testing.assert_array_equal(positions, ramp(10))


def test_what_is_past_when_the_chunk_comes_is_dropped_by_time(make_rig: type[Rig]):
    rig = make_rig()
    t_ns = rig.tick()
    rig.tick(4)
    rig.answer(ramp(10))
    ((start_ns, _, positions),) = rig.plans
    assert start_ns == t_ns + 4 * STEP
    np.testing.assert_array_equal(positions, ramp(6, first=4))
    assert rig.stats.latency_ms == 400.0
    assert rig.stats.plan_length == 5


def test_a_chunk_wholly_past_is_counted_and_the_next_asked_for(make_rig: type[Rig]):
    rig = make_rig(timeout_s=60.0)
    rig.tick(1)
    rig.tick(10)
    rig.answer(ramp(5))
    assert rig.plans == []
    assert (rig.stats.late_chunks, rig.stats.failures) == (1, 0)
    rig.tick()
    assert len(rig.requests) == 2


def test_a_chunk_that_begins_in_the_future_is_sent_for_its_own_time(make_rig: type[Rig]):
    rig = make_rig()
    t_ns = rig.tick()
    rig.answer(ramp(5), start_ns=t_ns + 3 * STEP)
    ((start_ns, _, positions),) = rig.plans
    assert start_ns == t_ns + 3 * STEP
    np.testing.assert_array_equal(positions, ramp(5))


def test_the_plan_running_dry_is_a_hold_and_the_next_chunk_joins_by_time(make_rig: type[Rig]):
    rig = make_rig(enabled=True, timeout_s=60.0)
    rig.tick()
    rig.answer(ramp(5))
    rig.tick(4)
    assert rig.stats.holds == 1
    rig.tick(6)
    assert rig.stats.holds == 1, "a hold counts once, however long"
    late = rig.requests[-1]
    rig.answer(ramp(20), late)
    start_ns, _, positions = rig.plans[-1]
    past = (rig.clock.now_ns() - late.frame.stamp_ns) // STEP
    assert past > 0
    assert start_ns == late.frame.stamp_ns + past * STEP
    np.testing.assert_array_equal(positions[0], np.full(SIZE, 4.0))  # where the arm was held, and not the chunk's 9.0
    assert positions.shape == (20 - past, SIZE)


def test_the_first_request_of_an_episode_does_not_count_as_hold(make_rig: type[Rig]):
    rig = make_rig(timeout_s=60.0)
    rig.tick(10)
    assert rig.stats.holds == 0


def test_a_request_times_out_is_retried_and_its_answer_dropped(make_rig: type[Rig], caplog: pytest.LogCaptureFixture):
    rig = make_rig(timeout_s=0.5)
    rig.tick()
    rig.tick(5)
    assert (rig.stats.timeouts, len(rig.requests)) == (0, 1), "0.5 s is not more than 0.5 s"
    with caplog.at_level(logging.WARNING, "ibrobot.dispatch"):
        rig.tick()
    assert (rig.stats.timeouts, rig.stats.failures) == (1, 1)
    assert "no chunk within 0.5 s" in caplog.text
    assert len(rig.requests) == 1, "a pause before the retry"
    rig.tick()
    assert len(rig.requests) == 2
    rig.answer(ramp(30), rig.requests[0])
    assert (rig.stats.dropped_answers, rig.plans) == (1, [])
    rig.answer(ramp(10), rig.requests[1])
    assert len(rig.plans) == 1


@pytest.mark.parametrize(
    "actions",
    [
        np.full((5, SIZE), np.nan),
        np.where(np.arange(5 * SIZE).reshape(5, SIZE) == 7, np.inf, 0.0),
        np.zeros((5, SIZE + 1)),
        np.zeros(SIZE),
        np.zeros((0, SIZE)),
        None,
    ],
    ids=["nan", "inf", "width", "rank", "empty", "none"],
)
def test_a_wrong_answer_is_a_failure_and_the_plan_stays(make_rig: type[Rig], actions: np.ndarray | None):
    rig = make_rig(watermark=8)
    rig.tick()
    rig.answer(ramp(10))
    rig.tick()
    rig.answer(actions)
    assert (rig.stats.failures, rig.stats.chunks, len(rig.plans)) == (1, 1, 1)
    assert len(rig.requests) == 2
    rig.tick()
    assert rig.stats.plan_length == 7, "the old plan goes on"
    assert len(rig.requests) == 3, "asked again after the pause"
    rig.answer(ramp(10))
    assert (rig.stats.chunks, len(rig.plans)) == (2, 2)


def test_a_policy_that_raises_is_a_failure_and_asked_again(make_rig: type[Rig], caplog: pytest.LogCaptureFixture):
    class Faulty(FakePolicy):
        fails = True

        def infer(self, tensors):
            if self.fails:
                raise RuntimeError("out of memory")
            return super().infer(tensors)

    policy = Faulty(host_context())
    client = LockstepClient(policy)
    rig = make_rig(client=client)

    def pump() -> None:
        if (chunk := client.poll()) is not None:
            rig.dispatcher.accept(chunk, rig.clock.now_ns())

    rig.tick()
    with caplog.at_level(logging.WARNING, "ibrobot.dispatch"):
        pump()
    assert (rig.stats.failures, rig.plans) == (1, [])
    assert "RuntimeError: out of memory" in caplog.text
    policy.fails = False
    rig.tick(5)
    pump()
    assert (rig.stats.failures, rig.stats.chunks, len(rig.plans)) == (1, 1, 1)


def test_nothing_is_asked_while_an_observation_is_missing_and_its_topic_is_reported(
    make_rig: type[Rig], caplog: pytest.LogCaptureFixture
):
    rig = make_rig()
    with caplog.at_level(logging.WARNING, "ibrobot.dispatch"):
        rig.tick(20, observed=False)
        assert caplog.text == ""
        rig.tick(1, observed=False)
    assert rig.requests == []
    assert [record.getMessage() for record in caplog.records] == ["holding: nothing new on /joint_states"]
    rig.tick()
    assert len(rig.requests) == 1


def test_an_observation_that_grew_too_old_is_missing(make_rig: type[Rig]):
    rig = make_rig()
    rig.tick()
    rig.answer(ramp(2))
    rig.tick(3, observed=False)
    assert len(rig.requests) == 2, "150 ms are allowed: one tick later it still counts, then no more"
    assert rig.requests[1].frame.stamp_ns == START_NS + 2 * STEP


def test_a_reset_drops_the_answer_in_flight_and_the_plan(make_rig: type[Rig]):
    rig = make_rig()
    rig.tick()
    before = rig.requests[0]
    rig.dispatcher.begin(8)
    assert rig.client.seeds == [7, 8]
    rig.answer(ramp(10), before)
    assert (rig.stats.dropped_answers, rig.plans) == (1, [])
    rig.tick()
    assert rig.requests[1].id != before.id
    rig.answer(ramp(10), before)
    assert (rig.stats.dropped_answers, rig.plans) == (2, [])


def test_after_the_end_nothing_is_asked_or_sent(make_rig: type[Rig]):
    rig = make_rig()
    rig.tick()
    rig.dispatcher.end()
    rig.answer(ramp(10))
    rig.tick(30)
    assert (len(rig.requests), rig.plans, rig.stats.dropped_answers) == (1, [], 1)
    rig.dispatcher.end()


def test_overlapping_chunks_blend_and_the_toggle_is_for_those_to_come(make_rig: type[Rig]):
    rig = make_rig(watermark=10, enabled=True, coeff=0.0)
    rig.tick()
    rig.answer(ramp(5) * 0)
    rig.tick()
    rig.answer(ramp(5) * 0 + 1)
    np.testing.assert_allclose(rig.plans[-1][2][:, 0], [0.5, 0.5, 0.5, 0.5, 1.0])
    rig.dispatcher.toggle_smoothing(False)
    assert not rig.stats.smoothing
    rig.tick()
    rig.answer(ramp(5) * 0 + 9)
    np.testing.assert_array_equal(rig.plans[-1][2][:, 0], [9.0] * 5)
    rig.dispatcher.toggle_smoothing(True)
    rig.tick()
    rig.answer(ramp(5) * 0)
    np.testing.assert_allclose(rig.plans[-1][2][:, 0], [4.5] * 4 + [0.0])


def test_a_policy_of_another_rate_gives_a_plan_of_its_own_step(make_rig: type[Rig]):
    rig = make_rig(watermark=3, rate_hz=20.0)
    t_ns = rig.tick()
    rig.answer(ramp(10))
    ((start_ns, step_ns, positions),) = rig.plans
    assert (start_ns, step_ns, len(positions)) == (t_ns, STEP // 2, 10)
    rig.tick()
    assert rig.stats.plan_length == 7, "two actions of 50 ms a tick of 100 ms"
    rig.tick()
    assert len(rig.requests) == 1
    rig.tick()
    assert (rig.stats.plan_length, len(rig.requests)) == (3, 2)


def test_a_chunk_that_comes_between_ticks_is_cut_at_the_time_of_its_arrival(make_rig: type[Rig]):
    rig = make_rig()
    t_ns = rig.tick()
    rig.clock.advance(2 * STEP + STEP // 2)
    rig.answer(ramp(10))
    ((start_ns, _, positions),) = rig.plans
    assert start_ns == t_ns + 2 * STEP
    np.testing.assert_array_equal(positions, ramp(8, first=2))


def test_a_new_episode_does_not_blend_with_the_old_one(make_rig: type[Rig]):
    rig = make_rig(enabled=True)
    rig.tick()
    rig.answer(ramp(10) * 0)
    rig.dispatcher.begin(8)
    rig.tick()
    rig.answer(ramp(5) * 0 + 1)
    np.testing.assert_array_equal(rig.plans[-1][2], np.ones((5, SIZE)))


def test_a_new_episode_does_not_go_on_from_where_the_old_one_was_held(make_rig: type[Rig]):
    rig = make_rig(strategy="rtc")
    rig.tick()
    rig.answer(ramp(3))
    rig.tick(5)
    rig.dispatcher.begin(8)
    rig.tick()
    assert rig.requests[-1].frame.prefix is None
    rig.answer(ramp(5, first=20))
    np.testing.assert_array_equal(rig.plans[-1][2], ramp(5, first=20))


def test_each_answer_is_reported_once_with_its_outcome(make_rig: type[Rig]):
    rig = make_rig(timeout_s=0.3, watermark=10)
    rig.tick()
    rig.answer(ramp(10))
    rig.tick()
    rig.answer(None, error="out of memory")
    rig.tick(3)
    rig.answer(ramp(10)[:, :2])
    while len(rig.reports) < 4:  # the next request times out
        rig.tick()
    rig.answer(ramp(10), rig.requests[3])
    ids, outcomes, errors = zip(*rig.reports, strict=True)
    assert ids == (1, 2, 3, 4, 4)
    assert outcomes == ("used", "failed", "failed", "failed", "dropped")
    assert "shape" in errors[2]
    assert (*errors[:2], *errors[3:]) == ("", "out of memory", "no chunk within 0.3 s", "")


def test_a_chunk_of_the_past_is_reported_as_late(make_rig: type[Rig]):
    rig = make_rig(timeout_s=60.0)
    rig.tick()
    rig.tick(5)
    rig.answer(ramp(3))
    assert rig.reports == [(1, "late", "")]
