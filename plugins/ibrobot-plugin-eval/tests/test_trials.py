import json
from collections import Counter

import attrs
import numpy as np
import pytest
from ibrobot_eval.blinded import Blinding, drift_over, power, trials_needed
from ibrobot_eval.comparison import compare
from ibrobot_eval.statistics import ALPHA, decided_by, drift
from ibrobot_eval.trials import FAILURE, OPENED, ORDER, SUCCESS, VOID, Order, Trial

from ibrobot_core.api import IbrobotError

from .made_results import result, results

LABELS = ("scripted", "learned", "third")


def judge(order, outcome=SUCCESS, reason=""):
    """Judge the next trial; returns the policy that acted."""
    block, place, label = order.next()
    order.add(Trial(len(order.trials) + 1, block, place, outcome, reason, 2.0, {}, (), order.seal))
    return label


def run(order, trials):
    return [judge(order) for _ in range(trials)]


def test_each_block_has_every_policy_once_in_random_order(tmp_path):
    order = Order(tmp_path, LABELS)
    acted = run(order, 60)
    blocks = [tuple(acted[i : i + 3]) for i in range(0, 60, 3)]
    assert all(sorted(block) == sorted(LABELS) for block in blocks)
    assert len(set(blocks)) > 3
    assert order.blocks == 20


def test_order_continues_after_a_crash(tmp_path):
    acted = run(Order(tmp_path, LABELS), 7)
    again = Order(tmp_path, LABELS)
    assert (len(again.trials), again.seal) == (7, Order(tmp_path, LABELS).seal)
    assert Counter(acted + run(again, 2)) == dict.fromkeys(LABELS, 3)


def test_void_trial_is_repeated_at_the_end_of_its_block(tmp_path):
    order = Order(tmp_path, LABELS)
    voided = judge(order, VOID, "the cable was loose")
    rest = run(order, 3)
    assert voided not in rest[:2]
    assert (rest[2], order.blocks) == (voided, 1)
    assert order.trials[0].reason == "the cable was loose"


def test_no_file_names_policies_before_the_order_is_opened(tmp_path):
    run(Order(tmp_path, LABELS), 9)
    for path in tmp_path.rglob("*"):
        assert not any(label in str(path.relative_to(tmp_path)) for label in LABELS)
        assert not path.is_file() or not any(label in path.read_text() for label in LABELS)


def test_opened_order_gives_each_policy_its_trials(tmp_path):
    order = Order(tmp_path, LABELS)
    for _ in range(4 * 3 + 1):  # the last block is not complete
        judge(order, SUCCESS if order.next()[2] == "learned" else FAILURE)
    found = order.open()
    assert {label: [each.outcome for each in trials] for label, trials in found.items()} == {
        "scripted": [FAILURE] * 4,
        "learned": [SUCCESS] * 4,
        "third": [FAILURE] * 4,
    }
    assert order.open() == found, "it can be read again"


def test_no_trial_follows_once_the_order_is_opened(tmp_path):
    order = Order(tmp_path, LABELS)
    run(order, 3)
    order.open()
    with pytest.raises(IbrobotError, match="further ones would not be blind"):
        run(order, 1)


def test_trials_after_the_opening_are_refused(tmp_path):
    order = Order(tmp_path, LABELS)
    run(order, 3)
    order.open()
    opened = (tmp_path / OPENED).read_text()
    (tmp_path / OPENED).unlink()
    run(order, 3)
    (tmp_path / OPENED).write_text(opened)
    with pytest.raises(IbrobotError, match="trials 4, 5, 6 were run after the order was opened, so they are not blind"):
        order.open()


def test_trials_under_another_order_are_refused(tmp_path):
    order = Order(tmp_path, LABELS)
    run(order, 3)
    (tmp_path / ORDER).unlink()
    with pytest.raises(IbrobotError, match="were not run under this sealed order, so they are not blind"):
        Order(tmp_path, LABELS).open()


def test_trial_without_a_seal_is_refused(tmp_path):
    order = Order(tmp_path, LABELS)
    run(order, 3)
    file = tmp_path / "trials/trial_0002.json"
    file.write_text(json.dumps(attrs.asdict(attrs.evolve(order.trials[1], seal=""))))
    with pytest.raises(IbrobotError, match="trial 2 was not run under this sealed order"):
        Order(tmp_path, LABELS).open()


def test_damaged_order_is_an_error(tmp_path):
    (tmp_path / ORDER).write_text("something else")
    with pytest.raises(IbrobotError, match="the sealed order cannot be read"):
        Order(tmp_path, LABELS)


@pytest.mark.parametrize("difference", [0.2, 0.3])
@pytest.mark.parametrize("policies", [2, 3, 10])
def test_stated_numbers_of_trials_have_a_power_of_80_percent(policies, difference):
    number = trials_needed(difference, policies)
    assert number is not None
    level = ALPHA / (policies * (policies - 1) / 2)
    power_of = decided_by(0.5 + difference / 2, 0.5 - difference / 2, number, level)
    assert power_of[-2] < 0.8 <= power_of[-1]
    lines = power(number, policies)
    assert f"{100 * difference:g} points: {number}" in lines[0]
    assert f"{100 * difference:g} points: 80 %" in lines[1]
    assert "for rates around 50 %" in lines[2]


def test_power_grows_with_the_number_of_policies():
    assert [trials_needed(0.3, policies) for policies in (2, 3, 5)] == [69, 87, 105]
    assert power(20, 1) == []


@pytest.mark.parametrize("tables", [30, pytest.param(200, marks=pytest.mark.long)])
def test_stated_number_of_trials_finds_a_difference_among_three_policies(tables):
    rng, rates = np.random.default_rng(0), np.array([0.65, 0.5, 0.35])
    number, found = trials_needed(0.3, 3), 0
    assert number is not None
    for _ in range(tables):
        outcomes = rng.random((number, 3)) < rates
        made = compare({name: results(*column) for name, column in zip("abc", outcomes.T, strict=True)}, 0.1)
        found += next(each for each in made if (each.first, each.second) == ("a", "c")).verdict == "better"
    assert found / tables > 0.72, "80 %, but for chance"


def trials(*outcomes):
    return [result(number, success) for number, success in enumerate(outcomes)]


@pytest.mark.parametrize("sign", [True, False])
@pytest.mark.parametrize("policies", [1, 2, 4])
def test_drift_is_said(policies, sign):
    found = drift_over({f"p{i}": trials(*[sign] * 10, *[not sign] * 10) for i in range(policies)})
    rates = "100 % in the first half, 0 % in the second" if sign else "0 % in the first half, 100 % in the second"
    assert found.startswith("the success rates drifted over the trials (p < 0.001): ")
    assert rates in found


def test_no_drift_is_said_too():
    assert drift_over({"a": trials(*[True, False] * 10)}).startswith("no drift of the success rates over the trials")
    assert drift_over({"a": trials(*[True] * 20), "b": trials(*[False] * 20)}).endswith("was found (p 1.000)")
    assert drift_over({"a": trials(True, False), "b": trials(False, False)}) == "", "too few trials"


def test_drift_is_seldom_found_where_there_is_none():
    rng = np.random.default_rng(0)
    found = [drift((rng.random((2, 12)) < np.array([[0.3], [0.8]])).tolist(), 399) <= ALPHA for _ in range(400)]
    assert np.mean(found) <= 0.08


def test_drift_that_all_policies_have_is_found_whatever_their_rates():
    rng = np.random.default_rng(1)
    rates = np.linspace(0.9, 0.2, 30) * np.array([[1.0], [0.6]])
    assert np.mean([drift((rng.random((2, 30)) < rates).tolist(), 399) <= ALPHA for _ in range(50)]) > 0.7


def test_blinding_replaces_names_but_not_parts_of_words():
    blind = Blinding(["act", "act_2", "runs/act_2/last"])
    text = "mode act_2 failed: runs/act_2/last is missing, active; mode act acts"
    assert blind(text) == "mode POLICY failed: POLICY is missing, active; mode POLICY acts"
