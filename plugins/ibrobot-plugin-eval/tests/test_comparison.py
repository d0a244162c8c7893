import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_eval.comparison import BETTER, SAME, UNDECIDED, WORSE, Decision, Summary, compare

from .made_results import result, results, spread


def test_25_and_29_of_50_are_undecided_with_a_projection():
    (found,) = compare({"a": spread(29, 50, 7), "b": spread(25, 50, 11)}, 0.1)
    assert found.verdict == UNDECIDED
    assert found.words.startswith("undecided between a and b; about ")
    assert found.words.endswith(" more episodes of each would decide")
    assert found.more_episodes is not None
    assert found.more_episodes > 50


def test_planted_fault_is_found_and_words_name_the_better_policy():
    good, bad = results(*[True] * 12), results(*[False] * 12)
    (found,), (mirrored,) = compare({"good": good, "bad": bad}, 0.1), compare({"bad": bad, "good": good}, 0.1)
    assert (found.verdict, found.words) == (BETTER, "good is better than bad")
    assert (mirrored.verdict, mirrored.words) == (WORSE, "bad is worse than good")
    assert found.interval.low == pytest.approx(-mirrored.interval.high, abs=1e-5)


def test_equal_outcomes_differ_by_no_more_than_the_margin_after_enough_episodes():
    few, many = ({label: spread(90, n) for label in "ab"} for n in (20, 200))
    assert compare(few, 0.1)[0].verdict == UNDECIDED
    (found,) = compare(many, 0.1)
    assert (found.verdict, found.words) == (SAME, "a and b differ by no more than 10 points")


@pytest.mark.long
def test_at_most_ten_of_200_comparisons_of_a_policy_with_itself_find_a_difference():
    rng = np.random.default_rng(0)
    different = 0
    for _ in range(200):
        outcomes = rng.random((2, 25)) < 0.7
        (found,) = compare({"a": results(*outcomes[0]), "b": results(*outcomes[1])}, 0.1)
        different += found.verdict in (BETTER, WORSE)
    assert different <= 10


def test_three_policies_are_corrected_for_three_pairs():
    outcomes = {"a": results(*[True] * 9), "b": results(*[False] * 9), "c": results(*[True] * 9)}
    pair = compare({name: outcomes[name] for name in "ab"}, 0.1)[0]
    of_three = compare(outcomes, 0.1)
    assert [(each.first, each.second) for each in of_three] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert of_three[0].p_value == pytest.approx(3 * pair.p_value)
    assert of_three[0].interval.low < pair.interval.low
    assert of_three[0].mcnemar_p == pytest.approx(3 * pair.mcnemar_p)


def test_decision_does_not_depend_on_how_often_one_looks():
    good, bad = results(*[True] * 20), results(*[False] * 20)
    at_once, one_by_one = Decision(["a", "b"], 0.1), Decision(["a", "b"], 0.1)
    at_once.look({"a": good, "b": bad})
    for count in range(21):
        one_by_one.look({"a": good[:count], "b": bad[: count - 1] if count else []})
    assert at_once.after == one_by_one.after == 8


def test_single_policy_is_never_decided():
    decision = Decision(["a"], 0.1)
    decision.look({"a": results(*[True] * 50)})
    assert decision.after is None


def test_summary_counts_successes_interventions_and_faults():
    made = [
        result(0, True, time_s=2.0, interventions={"velocity": 3}),
        result(1, True, time_s=4.0, interventions={"velocity": 1, "position": 2}),
        result(2, False, time_s=9.0, faults=("joint: stuck",)),
    ]
    found = Summary.of("a", made)
    assert (found.successes, found.episodes, found.median_time_s, found.disturbed) == (2, 3, 3.0, 1)
    assert found.interventions == {"position": 2, "velocity": 4}
    assert Summary.of("a", made[2:]).median_time_s is None


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 5), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_intervals_p_values_and_verdicts_of_a_table_agree(policies, episodes, seed):
    rng = np.random.default_rng(seed)
    outcomes = rng.random((policies, episodes)) < rng.random((policies, 1))
    for each in compare({str(i): results(*row.tolist()) for i, row in enumerate(outcomes)}, 0.1):
        decided = each.verdict in (BETTER, WORSE)
        assert decided == (each.p_value <= 0.05) == (each.interval.low > 0 or each.interval.high < 0)
        assert (each.verdict == BETTER) == (each.interval.low > 0)
        assert (each.mcnemar_p <= 0.05) == (each.fixed_interval.low > 0 or each.fixed_interval.high < 0)
        if each.verdict == SAME:
            assert -0.1 < each.interval.low <= each.interval.high < 0.1
