"""Which rows `--only` keeps, and who commanded an episode that does not say so."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_data.commanders import Commanders, stretches

from ibrobot_core.api import EpisodeSummary, Recorded, RecorderError, String, TopicSummary


@given(st.lists(st.booleans()), st.integers(0, 5))
def test_rows_within_the_context_are_kept_once_and_in_order(rows: list[bool], context: int) -> None:
    kept = list(stretches(rows, bool, context))
    numbers = [number for _, number, _ in kept]
    near = [any(rows[max(0, i - context) : i + context + 1]) for i in range(len(rows))]
    assert numbers == [i for i, each in enumerate(near) if each]
    assert [row for row, _, _ in kept] == [rows[number] for number in numbers]


@given(st.lists(st.booleans()), st.integers(0, 5))
def test_a_stretch_begins_where_a_row_is_missing(rows: list[bool], context: int) -> None:
    kept = list(stretches(rows, bool, context))
    before = [None, *(number for _, number, _ in kept)]
    for (_, number, begins), last in zip(kept, before, strict=False):
        assert begins == (last is None or number != last + 1)


@attrs.frozen
class Bag:
    """Messages on `/commander`, each with its time of receipt."""

    kept: tuple[tuple[int, str], ...]

    def messages(self, topics: object) -> Iterator[Recorded]:
        for time_ns, word in self.kept:
            yield Recorded("/commander", String(word), time_ns, time_ns)


def commanders(mode: dict[str, Any], *messages: tuple[int, str]) -> Commanders:
    metadata = {"mode": "it", "config": json.dumps({"control_modes": {"it": mode}})} if mode else {}
    topics = {"/commander": TopicSummary(String.ros_type, len(messages))}
    reader: Any = Bag(messages)
    return Commanders(reader, EpisodeSummary(Path("bag"), True, 0, 100, topics, metadata))


def test_the_newest_message_says_who_commands() -> None:
    found = commanders({}, (10, "policy"), (20, "policy"), (30, "handover"), (40, "operator"))
    assert [found.at(t) for t in (0, 10, 29, 30, 39, 40, 99)] == [
        "policy",
        "policy",
        "policy",
        "handover",
        "handover",
        "operator",
        "operator",
    ]


@pytest.mark.parametrize(
    ("mode", "who"), [({"teleop": "leader"}, "operator"), ({"inference": {}}, "policy"), ({"planner": {}}, "planner")]
)
def test_without_messages_the_mode_says_who_commands(mode: dict[str, Any], who: str) -> None:
    assert commanders(mode).at(50) == who


def test_an_episode_that_does_not_say_who_commanded_is_refused() -> None:
    with pytest.raises(RecorderError, match="it is unknown who commanded: the episode has no /commander"):
        commanders({})
