from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_eval.statistics import (
    ALPHA,
    PairedTest,
    Pairs,
    agreeing,
    clopper_pearson,
    corrected,
    decided_by,
    episodes_to_decide,
    level_of,
    log_capital,
    mcnemar_exact,
    tango,
    wilson,
)
from scipy.stats import binom
from simulated_experiments import covered, decided_at, mcnemar_power, reached, significant

EPISODES = 50
RATES = (0.02, 0.1, 0.25, 0.5, 0.7, 0.9, 0.95, 0.99)
COUNTS = st.builds(Pairs, *[st.integers(0, 60)] * 3).filter(lambda pairs: pairs.episodes > 0)


def counted(outcomes):
    """Pairs of outcomes, shape (n, 2) -> their counts."""
    return Pairs(
        sum(a and not b for a, b in outcomes), sum(b and not a for a, b in outcomes), sum(a == b for a, b in outcomes)
    )


def mirrored(pairs):
    return Pairs(pairs.second, pairs.first, pairs.same)


def test_wilson_interval_of_94_of_100_overlaps_that_of_91():
    better, worse = wilson(94, 100), wilson(91, 100)
    assert (round(better.low, 4), round(better.high, 4)) == (0.8752, 0.9722)
    assert worse.high > better.low


@pytest.mark.parametrize("rate", RATES)
def test_exact_interval_covers_every_rate_at_least_nominally(rate):
    found = [clopper_pearson(k, EPISODES) for k in range(EPISODES + 1)]
    covering = [each.low <= rate <= each.high for each in found]
    assert binom.pmf(np.arange(EPISODES + 1), EPISODES, rate)[covering].sum() >= 1 - ALPHA


def test_interval_without_episodes_says_nothing():
    assert (wilson(0, 0).low, wilson(0, 0).high) == (0.0, 1.0)
    assert (tango(Pairs(0, 0, 0)).low, tango(Pairs(0, 0, 0)).high) == (-1.0, 1.0)


def test_mcnemar_counts_only_episodes_with_different_outcomes():
    assert mcnemar_exact(Pairs(10, 0, 0)) == mcnemar_exact(Pairs(10, 0, 90)) == 2 / 2**10
    assert mcnemar_exact(Pairs(0, 0, 50)) == 1.0


@given(COUNTS)
def test_intervals_of_a_difference_contain_it_and_mirror(pairs):
    found, other = tango(pairs), tango(mirrored(pairs))
    assert -1 <= found.low <= pairs.difference <= found.high <= 1
    assert (found.low, found.high) == pytest.approx((-other.high, -other.low), abs=1e-6)


@given(COUNTS)
def test_tango_and_mcnemar_agree_on_clear_cases(pairs):
    found = tango(pairs)
    if mcnemar_exact(pairs) < 0.01:
        assert found.low > 0 or found.high < 0
    if mcnemar_exact(pairs) > 0.2:
        assert found.low <= 0 <= found.high


def test_tango_covers_about_nominally():
    rng = np.random.default_rng(0)
    missed = 0
    for counts in rng.multinomial(EPISODES, [0.25, 0.05, 0.7], 2000):
        found = tango(Pairs(*map(int, counts)))
        missed += not found.low <= 0.2 <= found.high
    assert missed / 2000 <= 0.065


@given(st.floats(0, 1), st.integers(0, 50))
def test_corrected_p_and_level_decide_alike(p_value, pairs):
    level = level_of(pairs)
    assert (p_value <= level) == (corrected(p_value, pairs) <= ALPHA) or p_value == pytest.approx(level)


@given(COUNTS, st.sampled_from([1, 3, 10, 45, 500]))
def test_interval_of_a_fixed_number_excludes_zero_exactly_if_mcnemar_decides(pairs, tests):
    decided = corrected(mcnemar_exact(pairs), tests) <= ALPHA
    found = agreeing(tango(pairs, level_of(tests)), decided, pairs.difference)
    assert (found.low > 0 or found.high < 0) == decided
    assert found.low <= pairs.difference <= found.high


@given(st.floats(-0.9, 0.9), st.integers(0, 30), st.integers(0, 30), st.integers(0, 30))
def test_bets_against_the_true_difference_are_fair(difference, first, second, same):
    # Any distribution with this mean will do: the two that touch the corners of what is possible.
    won = (1 + difference) / 2
    for ahead, behind in ((won, 1 - won), (max(difference, 0.0), max(-difference, 0.0))):
        tie = 1 - ahead - behind
        expected = (
            ahead * np.exp(log_capital(first + 1, second, same, difference))
            + behind * np.exp(log_capital(first, second + 1, same, difference))
            + tie * np.exp(log_capital(first, second, same + 1, difference))
        )
        assert expected == pytest.approx(np.exp(log_capital(first, second, same, difference)), rel=1e-9)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=80))
def test_interval_only_narrows_and_excludes_zero_exactly_when_the_test_rejects(outcomes):
    test = PairedTest()
    for first, second in outcomes:
        before = test.interval
        test.add(first, second)
        assert before.low <= test.interval.low <= test.interval.high <= before.high
    away = max(test.interval.low, -test.interval.high)
    assert away > -1e-5 if test.p_value <= ALPHA else away < 1e-5


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=80))
def test_ends_of_the_interval_are_refuted_and_what_is_a_millionth_nearer_is_not(outcomes):
    test, limit = PairedTest(), -np.log(ALPHA)
    for first, second in outcomes:
        before = test.interval
        test.add(first, second)
        counts = test.pairs.first, test.pairs.second, test.pairs.same
        for end, old, inwards in (
            (test.interval.low, before.low, 1e-6), (test.interval.high, before.high, -1e-6)
        ):  # fmt: skip
            if end != old:
                assert log_capital(*counts, end) >= limit > log_capital(*counts, end + inwards)


def test_test_counts_its_pairs():
    outcomes = [(True, False)] * 9 + [(False, True)] + [(True, True)] * 5
    test = PairedTest()
    for first, second in outcomes:
        test.add(first, second)
    assert test.pairs == counted(outcomes) == Pairs(9, 1, 5)
    assert test.sign == 1


def test_25_and_29_of_50_are_undecided_and_94_and_91_of_100_too():
    for first, second, episodes in ((29, 25, 50), (94, 91, 100)):
        test = PairedTest()
        for seed in range(episodes):
            test.add(seed * 37 % episodes < first, seed * 11 % episodes < second)
        assert (test.pairs.first - test.pairs.second) == first - second
        assert test.p_value > ALPHA
        more = episodes_to_decide(test.pairs, 0.1)
        assert more is not None
        assert more > 50


def test_policy_that_always_fails_where_another_succeeds_is_found_after_eight_episodes():
    test = PairedTest()
    while test.p_value > ALPHA:
        test.add(True, False)
    assert test.pairs.episodes == 8


def test_equal_policies_are_seldom_called_different_under_peeking():
    # Exact: every path of 500 episodes with different outcomes, looked at after each of them.
    false_positives = decided_by(0.5, 0.5, 500)
    assert 0.03 < false_positives[-1] <= ALPHA
    assert (np.diff(false_positives) >= 0).all()


def test_exact_probability_of_a_decision_agrees_with_simulation():
    rng = np.random.default_rng(1)
    exact = decided_by(0.9, 0.5, 60)
    decided = np.zeros(61)
    capital = cache(log_capital)
    for _ in range(300):
        outcomes = rng.random((60, 2)) < (0.9, 0.5)
        for n in range(1, 61):
            pairs = counted(outcomes[:n].tolist())
            if capital(pairs.first, pairs.second, 0, 0.0) >= -np.log(ALPHA):
                decided[n:] += 1
                break
    assert np.abs(decided / 300 - exact).max() < 0.09


def test_true_difference_is_seldom_refuted_under_peeking():
    rng = np.random.default_rng(2)
    capital = cache(log_capital)
    refuted = 0
    for counts in rng.multinomial(1, [0.32, 0.12, 0.56], (200, 60)).cumsum(axis=1):
        refuted += max(capital(*each, 0.2) for each in counts.tolist()) >= -np.log(ALPHA)
    assert 0 < refuted / 200 <= ALPHA


def test_projection_is_the_smallest_number_that_decides_at_the_present_frequencies():
    pairs = Pairs(4, 1, 5)
    more = episodes_to_decide(pairs, 0.05)
    assert more is not None
    scale = (pairs.episodes + more) / pairs.episodes
    assert log_capital(4 * scale, scale, 5 * scale, 0.0) >= -np.log(ALPHA)
    scale = (pairs.episodes + more - 1) / pairs.episodes
    assert log_capital(4 * scale, scale, 5 * scale, 0.0) < -np.log(ALPHA)


def test_equal_outcomes_are_projected_to_differ_by_less_than_the_margin():
    wide, narrow = (episodes_to_decide(Pairs(0, 0, 20), margin) for margin in (0.1, 0.02))
    assert wide is not None
    assert narrow is not None
    assert 0 < wide < narrow
    assert episodes_to_decide(Pairs(500, 500, 0), 1e-4) is None


def test_sequential_test_needs_about_as_many_episodes_as_a_fixed_one():
    assert mcnemar_power(0.9, 0.6, 47) >= 0.9 > mcnemar_power(0.9, 0.6, 43)
    mean = (1 - decided_by(0.9, 0.6, 500)).sum()
    assert 30 < mean < 47


def test_benchmark_finds_what_it_states_with_few_experiments():
    rng = np.random.default_rng(3)
    for rate in (0.1, 0.9):
        assert covered(rate, rng, 400)["clopper_pearson"] >= 0.94
    wrong, peeked = (
        sum(map(bool, decided_at(0.5, 0.5, rng, 400, table(150)))) / 400 for table in (reached, significant)
    )
    assert wrong <= ALPHA < 0.12 < peeked
