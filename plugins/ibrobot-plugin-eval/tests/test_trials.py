import json
from collections import Counter

import attrs
import pytest
from ibrobot_eval.blinded import NEEDED, Blinding, power
from ibrobot_eval.statistics import decided_by
from ibrobot_eval.trials import FAILURE, OPENED, ORDER, SUCCESS, VOID, Order, Trial

from ibrobot_core.api import IbrobotError

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


def test_stated_numbers_of_trials_have_a_power_of_80_percent():
    for difference in (0.2, 0.3):
        power_of = decided_by(0.5 + difference / 2, 0.5 - difference / 2, NEEDED[difference])
        assert power_of[-2] < 0.8 <= power_of[-1]
    lines = power(69)
    assert "10 points: 770, 20 points: 164, 30 points: 69" in lines[0]
    assert "30 points: 80 %" in lines[1]


def test_blinding_replaces_names_but_not_parts_of_words():
    blind = Blinding(["act", "act_2", "runs/act_2/last"])
    text = "mode act_2 failed: runs/act_2/last is missing, active; mode act acts"
    assert blind(text) == "mode POLICY failed: POLICY is missing, active; mode POLICY acts"
