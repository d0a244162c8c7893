"""Recordings and cards from anywhere: what is damaged is named, and accuses nobody."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_diagnose.card import Card, make_card
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.contents import read_contents, write_report
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.references import dataset_info
from ibrobot_diagnose.report import Explanation
from ibrobot_diagnose.testing import make_window
from ibrobot_diagnose.window import Window, read_window
from made_runs import START_NS, Made, Run, metadata, window_of

from ibrobot_core.api import (
    DatasetError,
    EpisodeSummary,
    Float64MultiArray,
    JointState,
    ModelAnswer,
    Recorded,
    RecorderError,
)

RUN = Run(seed=3, seconds=2, cameras=(), outcome="failure")
type Change = Callable[[Recorded], Recorded]


class Changed(Made):
    """A run whose messages or metadata are changed."""

    def __init__(self, change: Change = lambda item: item, run: Run = RUN, **more: str) -> None:
        super().__init__(run)
        self._messages = [change(item) for item in self._messages]
        self._more = more

    @override
    def summary(self) -> EpisodeSummary:
        return attrs.evolve(super().summary(), metadata={**metadata(self.run), **self._more})


def of_answers(**numbers: Any) -> Change:
    def change(item: Recorded) -> Recorded:
        if not isinstance(item.message, ModelAnswer):
            return item
        return attrs.evolve(item, message=attrs.evolve(item.message, **numbers))

    return change


@pytest.mark.parametrize(
    ("numbers", "problem"),
    [
        ({"actions": np.zeros(161)}, "answer 1 of the model has 161 numbers for 4 joints"),
        ({"step_ns": 0}, "answer 1 of the model has actions for 4 joints, 0 ns apart"),
        ({"joint_names": ()}, "answer 1 of the model has actions for 0 joints"),
        ({"latency_ms": float("nan")}, "answer 1 of the model took nan ms"),
        ({"actions": np.full(160, np.inf)}, "answer 1 of the model has an action that is not a finite number"),
    ],
)
def test_damaged_answer_is_named(numbers, problem):
    with pytest.raises(RecorderError, match=f"made: {problem}"):
        read_window(Changed(of_answers(**numbers)))


def set_clock(item: Recorded) -> Recorded:
    return item if item.received_ns < START_NS + 1e9 else attrs.evolve(item, received_ns=item.received_ns + 10**18)


def test_clock_that_was_set_takes_no_memory_and_is_named():
    with pytest.raises(RecorderError, match=r"made: its messages span 1000000002 s, .* `ibrobot episodes trim`"):
        read_window(Changed(set_clock))


@pytest.mark.parametrize(
    ("key", "text", "problem"),
    [
        ("config", "{", "its metadata config cannot be read"),
        ("config", "[" * 100_000, "its metadata config cannot be read"),
        ("config", "[]", "its metadata config is not an object"),
        ("policy", "3", "its metadata policy is not an object"),
        ("config", '{"control": []}', None),
        ("config", '{"control": [1]}', "config: control: must be a dict"),
        ("config", '{"control_modes": {"learned": 3}}', "config: control_modes: must contain only objects"),
        ("config", '{"robot": {"joints": ["pan"]}}', "config: robot.joints: must contain only objects"),
        ("config", '{"peripherals": [3]}', "config: peripherals: must contain only objects"),
        ("config", '{"control_modes": {"learned": {"dispatch": "fast"}}}', "config: control_modes: dispatch: is not"),
        ("contract", "[" * 100_000, "has no contract"),
        ("contract", {"rate_hz": 1e-300}, "the rate of its contract is 1e-300 Hz"),
        ("contract", {"rate_hz": float("inf")}, "the rate of its contract is inf Hz"),
    ],
)
def test_damaged_metadata_is_named(key, text, problem):
    if isinstance(text, dict):
        text = json.dumps({**json.loads(metadata(RUN)[key]), **text})
    reader = Changed(**{key: text})
    if problem is None:
        assert diagnose(read_window(reader), Reference()).broken == ()
        return
    with pytest.raises(RecorderError, match=f"made: {problem}"):
        read_window(reader)


def test_contract_with_a_topic_that_is_no_text_is_named():
    contract = json.loads(metadata(RUN)["contract"])
    contract["action"][0]["topic"] = ["/a"]
    with pytest.raises(RecorderError, match="made: its contract has a topic or a joint whose name is not text"):
        read_window(Changed(contract=json.dumps(contract)))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.filterwarnings("error")
def test_positions_that_are_no_numbers_are_what_is_accused(value):
    def change(item: Recorded) -> Recorded:
        if not isinstance(item.message, JointState):
            return item
        position = item.message.position.copy()
        position[1] = value
        return attrs.evolve(item, message=attrs.evolve(item.message, position=position))

    diagnosis = diagnose(read_window(Changed(change)), Reference())
    assert (diagnosis.first, diagnosis.broken) == ("readings_missing", ())
    assert diagnosis.findings[0].evidence.text.startswith("lift has no position in 100 % of the readings")


@pytest.mark.parametrize("joint", [0, 1])
def test_joint_without_readings_is_diagnosed_beside_one_that_follows_exactly(joint):
    """As in datasets whose commands are copies of the readings."""
    states = np.sin(np.linspace([0, 1], [10, 11], 300))
    states[:, joint] = np.nan
    diagnosis = diagnose(make_window(states), Reference())
    assert (diagnosis.first, diagnosis.broken) == ("readings_missing", ())


def test_contract_without_joints_is_diagnosed():
    contract = json.loads(metadata(RUN)["contract"])
    contract["action"][0]["joints"] = []
    assert diagnose(read_window(Changed(contract=json.dumps(contract))), Reference()).broken == ()


def test_contract_that_names_a_joint_twice_is_refused():
    contract = json.loads(metadata(RUN)["contract"])
    contract["action"][0]["joints"][1] = "pan"
    with pytest.raises(RecorderError, match="made: its contract commands pan twice"):
        read_window(Changed(contract=json.dumps(contract)))


def test_commands_that_are_no_numbers_are_what_is_accused():
    def change(item: Recorded) -> Recorded:
        if not isinstance(item.message, Float64MultiArray) or item.received_ns % 3:
            return item
        return attrs.evolve(item, message=Float64MultiArray(np.array([0.0, 0.0, np.inf, 0.0])))

    diagnosis = diagnose(read_window(Changed(change)), Reference())
    assert diagnosis.first == "readings_missing"
    assert "elbow has no position in" in diagnosis.findings[0].evidence.text
    assert "of the commands" in diagnosis.findings[0].evidence.text


@pytest.fixture(scope="module")
def card() -> dict[str, Any]:
    demos = (Run(seed=seed, acts=False, seconds=2, cameras=()) for seed in range(2))
    facts: dict[str, Any] = json.loads(json.dumps(make_card(map(window_of, demos)).facts()))
    return facts


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("series", {}, "series lacks 'seconds'"),
        ("trained", [1], "trained and statistics must be objects or null"),
        ("statistics", "x", "trained and statistics must be objects or null"),
    ],
)
def test_damaged_card_is_named_and_no_cause_is_blamed_for_it(card, tmp_path, key, value, problem):
    file = tmp_path / "reference.json"
    file.write_text(json.dumps({**card, key: value}))
    with pytest.raises(DatasetError, match=rf"reference\.json: cannot be read as a card of data: {problem}"):
        Card.read(file)


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ({"total_episodes": 10_000_000}, "total_episodes must be from 0 to 1000000"),
        ({"fps": 0}, "fps must be above 0"),
        ({"fps": float("inf")}, "fps must be above 0, and at most"),
        ({"features": {"action": []}}, "features must be an object of objects"),
        ({"total_episodes": float("inf")}, "OverflowError"),
    ],
)
def test_damaged_description_of_a_dataset_is_named(tmp_path, more, problem):
    file = tmp_path / "meta" / "info.json"
    file.parent.mkdir()
    file.write_text(json.dumps({"total_episodes": 2, "fps": 30, "features": {}, **more}))
    with pytest.raises(DatasetError, match=rf"info\.json: cannot be read: .*{problem}"):
        dataset_info(tmp_path)


NAMES = ("<script>alert(1)</script>", '"><img src=x onerror=alert(1)>', "</title>", "a\udc80b", "\x1b[2J")


@pytest.mark.parametrize("name", NAMES)
def test_texts_of_a_recording_are_no_markup_of_the_report(tmp_path, name):
    window: Window = attrs.evolve(window_of(Run(seed=4, seconds=2, cameras=(name,), prompt=name)), name=name)
    reference = Reference(make_card([window_of(Run(seed=5, seconds=2, cameras=(name,), acts=False))]))
    explanation = Explanation.of(window, reference, diagnose(window, reference))
    assert "other_prompt" in {each.name for each in explanation.diagnosis.findings}
    write_report(tmp_path, explanation, tmp_path / "a #1%")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count("<script") == 1
    assert "<img src=x" not in page
    assert page.count("</title></head>") + page.count("</title><style>") == 1
    assert 'href="a%20%231%25"' in page
    assert read_contents(tmp_path)
