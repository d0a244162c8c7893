"""The temporal smoother against the formula written out, and its handling of time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ibrobot_core.dispatch.smoother import LeadIn, TemporalSmoother

STEP = 33_333_333
T0 = 1_700_000_000_000_000_000


def chunk(seed: int, length: int, size: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-2, 2, (length, size))


def weighted_mean(predictions: list[np.ndarray], coeff: float) -> np.ndarray:
    """The formula, unrolled: the oldest prediction has the weight exp(0)."""
    weights = np.exp(-coeff * np.arange(len(predictions)))
    return (np.array(predictions) * weights[:, None]).sum(axis=0) / weights.sum()


class StepwiseEnsemble:
    """The recurrence taken literally: one chunk of fixed length a step, one action popped a step."""

    def __init__(self, coeff: float, length: int) -> None:
        self.weights = np.exp(-coeff * np.arange(length))
        self.cumsum = np.cumsum(self.weights)
        self.plan: np.ndarray | None = None
        self.counts = np.ones(length, dtype=int)

    def update(self, new: np.ndarray) -> np.ndarray:
        if self.plan is None:
            self.plan, self.counts = new.copy(), np.ones(len(new), dtype=int)
        else:
            c = self.counts
            old = self.plan * self.cumsum[c - 1][:, None]
            blended = (old + new[:-1] * self.weights[c][:, None]) / self.cumsum[c][:, None]
            self.plan, self.counts = np.vstack([blended, new[-1:]]), np.append(c + 1, 1)
        action, self.plan, self.counts = self.plan[0], self.plan[1:], self.counts[1:]
        return action


coefficients = st.sampled_from([0.01, 0.0, 0.1, 1.0, -0.05, -2.0, 50.0])


@settings(deadline=None)
@given(coeff=coefficients, length=st.integers(2, 40), updates=st.integers(1, 60), seed=st.integers(0, 999))
def test_one_chunk_a_step_is_the_stepwise_ensemble(coeff: float, length: int, updates: int, seed: int) -> None:
    smoother, ensemble = TemporalSmoother(STEP, 3, coeff=coeff), StepwiseEnsemble(coeff, length)
    for k in range(updates):
        now = T0 + k * STEP
        smoother.trim(now)
        smoother.update(chunk(seed + k, length), now)
        start, positions = smoother.plan()
        assert start == now
        np.testing.assert_allclose(positions[0], ensemble.update(chunk(seed + k, length)), atol=1e-6, rtol=0)


requests = st.tuples(st.integers(0, 30), st.integers(1, 40), st.integers(0, 25), st.floats(0, 0.999))


@settings(deadline=None)
@given(coeff=coefficients, events=st.lists(requests, min_size=1, max_size=25), seed=st.integers(0, 999))
def test_any_use_is_the_mean_of_the_predictions_for_each_time(
    coeff: float, events: list[tuple[int, int, int, float]], seed: int
) -> None:
    """Chunks at a watermark, at every step, late ones, and after the plan ran dry: per time step, the weighted mean."""
    smoother = TemporalSmoother(STEP, 3, coeff=coeff)
    predictions: dict[int, list[np.ndarray]] = {}
    now = 0
    for i, (wait, length, latency, within) in enumerate(events):
        now += wait
        now_ns = T0 + now * STEP + int(within * STEP)
        smoother.trim(now_ns)
        new = chunk(seed + i, length)
        joined = smoother.update(new, T0 + (now - latency) * STEP)
        predictions = {step: p for step, p in predictions.items() if step >= now}
        live = [k for k in range(length) if now - latency + k >= now]
        for k in live:
            predictions.setdefault(now - latency + k, []).append(new[k])
        assert joined == len(live)
        start, positions = smoother.plan()
        assert len(positions) == len(predictions)
        if predictions:
            assert start == T0 + now * STEP
            expected = [weighted_mean(predictions[step], coeff) for step in sorted(predictions)]
            np.testing.assert_allclose(positions, expected, atol=1e-6, rtol=0)
        assert smoother.remaining(now_ns) == max(len(predictions) - 1, 0)


def test_counts_beyond_the_chunk_length_still_follow_the_formula() -> None:
    smoother = TemporalSmoother(STEP, 3, coeff=0.01)
    new = [chunk(k, 4) for k in range(600)]
    for actions in new:
        smoother.update(actions, T0)
    expected = [weighted_mean([actions[i] for actions in new], 0.01) for i in range(4)]
    np.testing.assert_allclose(smoother.plan()[1], expected, atol=1e-6, rtol=0)


def test_a_chunk_that_comes_after_the_plan_ran_dry_begins_at_the_action_of_now() -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    now = T0 + 25 * STEP + STEP // 2
    assert smoother.remaining(now) == 0
    smoother.trim(now)
    late = chunk(2, 50)
    observed = T0 + 8 * STEP + 12_345  # off the old plan's grid, and while that still ran
    assert smoother.update(late, observed) == 50 - 17
    start, positions = smoother.plan()
    assert start == observed + 17 * STEP
    assert start <= now < start + STEP
    np.testing.assert_array_equal(positions, late[17:])


@pytest.mark.parametrize("begin", [11 * STEP, 12 * STEP + 7, 10**15])
def test_a_chunk_observed_after_the_end_of_an_untrimmed_plan_starts_at_its_own_times(begin: int) -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    smoother.update(chunk(2, 5), T0 + begin)
    assert smoother.plan()[0] == T0 + begin
    np.testing.assert_array_equal(smoother.plan()[1], chunk(2, 5))


@pytest.mark.parametrize("length", [1, 10])
def test_a_chunk_that_begins_where_a_plan_has_just_ended_continues_it(length: int) -> None:
    smoother = TemporalSmoother(STEP, 3, enabled=False, lead_in=lambda before, actions: np.zeros_like(actions))
    for k in range(3):
        begin = T0 + k * length * STEP
        smoother.trim(begin)
        smoother.update(chunk(k, length), begin)
        np.testing.assert_array_equal(smoother.plan()[1], chunk(k, length))


def test_a_chunk_that_begins_after_the_arm_was_held_leads_in() -> None:
    smoother = TemporalSmoother(STEP, 3, enabled=False, lead_in=lambda before, actions: np.zeros_like(actions))
    smoother.update(chunk(1, 10), T0)
    begin = T0 + 11 * STEP
    smoother.trim(begin)
    smoother.update(chunk(2, 5), begin)
    np.testing.assert_array_equal(smoother.plan()[1], np.zeros((5, 3)))


@settings(deadline=None)
@given(
    enabled=st.booleans(),
    late=st.integers(0, 10),
    every=st.integers(1, 20),
    distance=st.floats(-2, 2),
    coeff=coefficients,
)
def test_after_a_hold_no_step_is_faster_than_the_joint(
    enabled: bool, late: int, every: int, distance: float, coeff: float
) -> None:
    """Chunks of a sine that the arm is away from; each describes the sine, not the lead-in to it."""
    step_s, fastest = STEP / 1e9, 2.0
    lead_in = LeadIn(step_s, np.array([fastest]), np.array([20.0]))
    smoother = TemporalSmoother(STEP, 1, coeff=coeff, enabled=enabled, lead_in=lead_in)
    smoother.reset(np.array([distance]))
    at = [distance]
    for step in range(late, 150):
        now = T0 + step * STEP
        smoother.trim(now)
        if (step - late) % every == 0:
            seen = step - late + np.arange(40)
            smoother.update(0.4 * np.sin(2.0 * seen * step_s)[:, None], now - late * STEP)
        at.append(smoother.plan()[1][0, 0])
    assert np.abs(np.diff(at)).max() <= fastest * step_s


def test_a_chunk_that_begins_where_the_plan_ends_is_appended() -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    smoother.update(chunk(2, 5), T0 + 10 * STEP)
    np.testing.assert_array_equal(smoother.plan()[1], np.vstack([chunk(1, 10), chunk(2, 5)]))


def test_a_chunk_wholly_past_changes_nothing() -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 40), T0)
    smoother.trim(T0 + 20 * STEP)
    assert smoother.update(chunk(2, 20), T0) == 0
    assert smoother.plan()[0] == T0 + 20 * STEP
    np.testing.assert_array_equal(smoother.plan()[1], chunk(1, 40)[20:])
    smoother.trim(T0 + 100 * STEP)
    smoother.trim(T0 + 90 * STEP)
    assert smoother.update(chunk(3, 20), T0 + 80 * STEP) == 0
    assert smoother.plan()[1].shape == (0, 3)


def test_a_shorter_chunk_leaves_the_rest_of_the_plan() -> None:
    smoother = TemporalSmoother(STEP, 3, coeff=0.0)
    smoother.update(chunk(1, 10), T0)
    smoother.update(chunk(2, 3), T0 + 2 * STEP)
    expected = chunk(1, 10)
    expected[2:5] = (expected[2:5] + chunk(2, 3)) / 2
    np.testing.assert_allclose(smoother.plan()[1], expected)


@pytest.mark.parametrize(("off", "first"), [(-0.49, 3), (0.49, 3), (0.51, 4), (-0.51, 2)])
def test_a_chunk_off_the_grid_goes_to_the_nearest_step(off: float, first: int) -> None:
    smoother = TemporalSmoother(STEP, 3, coeff=0.0)
    smoother.update(np.zeros((10, 3)), T0)
    smoother.update(np.ones((3, 3)), T0 + 3 * STEP + int(off * STEP))
    start, positions = smoother.plan()
    assert start == T0
    np.testing.assert_array_equal(np.nonzero(positions[:, 0])[0], [first, first + 1, first + 2])


def test_off_grid_chunks_do_not_drift() -> None:
    smoother = TemporalSmoother(STEP, 1)
    for k in range(500):
        now = T0 + k * STEP + (k * 7919 % STEP) // 3
        smoother.trim(now)
        smoother.update(np.full((20, 1), float(k)), now)
        start, _ = smoother.plan()
        assert (start - T0) % STEP == 0
        assert start <= now < start + STEP


def test_without_smoothing_the_chunk_replaces_the_plan_from_its_start() -> None:
    smoother = TemporalSmoother(STEP, 3, enabled=False)
    smoother.update(chunk(1, 10), T0)
    smoother.update(chunk(2, 4), T0 + 3 * STEP)
    np.testing.assert_array_equal(smoother.plan()[1], np.vstack([chunk(1, 10)[:3], chunk(2, 4)]))
    smoother.trim(T0 + 5 * STEP)
    assert smoother.update(chunk(3, 9), T0 + 2 * STEP + 11) == 7
    assert smoother.plan()[0] == T0 + 4 * STEP + 11, "the action in effect, at the chunk's own exact times"
    np.testing.assert_array_equal(smoother.plan()[1], chunk(3, 9)[2:])


def test_toggle_applies_to_the_chunks_to_come() -> None:
    smoother = TemporalSmoother(STEP, 1, coeff=0.0)
    smoother.update(np.zeros((4, 1)), T0)
    smoother.update(np.ones((4, 1)), T0)
    smoother.enabled = False
    np.testing.assert_allclose(smoother.plan()[1], 0.5)
    smoother.update(np.full((4, 1), 3.0), T0 + STEP)
    np.testing.assert_allclose(smoother.plan()[1][:, 0], [0.5, 3, 3, 3, 3])
    smoother.enabled = True
    smoother.update(np.full((4, 1), 5.0), T0 + STEP)
    np.testing.assert_allclose(smoother.plan()[1][:, 0], [0.5, 4, 4, 4, 4])


def test_reset_forgets_plan_and_time() -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    smoother.trim(T0 + 5 * STEP)
    smoother.reset()
    assert smoother.plan()[1].shape == (0, 3)
    assert smoother.remaining(T0) == 0
    assert smoother.update(chunk(2, 4), 0) == 4
    assert smoother.plan()[0] == 0


def test_trim_keeps_the_action_in_effect_and_never_goes_back() -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    smoother.trim(T0 - 5 * STEP)
    assert (smoother.plan()[0], smoother.remaining(T0 - 1)) == (T0, 10)
    smoother.trim(T0 + 4 * STEP + STEP - 1)
    assert (smoother.plan()[0], smoother.remaining(T0 + 4 * STEP)) == (T0 + 4 * STEP, 5)
    smoother.trim(T0)
    assert smoother.plan()[0] == T0 + 4 * STEP
    smoother.trim(T0 + 9 * STEP)
    assert len(smoother.plan()[1]) == 1
    smoother.trim(T0 + 10 * STEP)
    assert len(smoother.plan()[1]) == 0


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (np.zeros((4, 2)), r"shape \(N, 3\) with N >= 1, got \(4, 2\)"),
        (np.zeros((0, 3)), r"got \(0, 3\)"),
        (np.zeros(3), r"got \(3,\)"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), "nan in action 1, element 1"),
        (np.array([[np.inf, 0, 0]]), "inf in action 0, element 0"),
    ],
)
def test_a_malformed_chunk_is_refused_and_the_plan_stays(bad: np.ndarray, message: str) -> None:
    smoother = TemporalSmoother(STEP, 3)
    smoother.update(chunk(1, 10), T0)
    with pytest.raises(ValueError, match=message):
        smoother.update(bad, T0 + STEP)
    assert smoother.plan()[0] == T0
    np.testing.assert_array_equal(smoother.plan()[1], chunk(1, 10))


def test_plans_handed_out_and_chunks_taken_in_share_nothing() -> None:
    smoother = TemporalSmoother(STEP, 3)
    given_chunk = chunk(1, 10)
    smoother.update(given_chunk, T0)
    handed_out = smoother.plan()[1]
    given_chunk[:] = 9
    smoother.update(chunk(2, 10), T0)
    np.testing.assert_array_equal(handed_out, chunk(1, 10))
    with pytest.raises(ValueError, match="read-only"):
        smoother.plan()[1][:] = 0


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"step_ns": 0, "action_size": 3}, "step_ns must be at least 1, got 0"),
        ({"step_ns": 1, "action_size": 0}, "action_size must be at least 1, got 0"),
        ({"step_ns": 1, "action_size": 3, "coeff": float("nan")}, "coeff must lie between -700 and 700, got nan"),
    ],
)
def test_impossible_settings_are_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TemporalSmoother(**kwargs)
