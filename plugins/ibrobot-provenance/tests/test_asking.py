"""Events in the output of a command are read as its classes; what is none of them is an error."""

from __future__ import annotations

import json
from typing import Any

import attrs
import pytest
from ibrobot_provenance.asking import read_event

from ibrobot_core.api import option
from ibrobot_core.app import Event, Failed, WireError


@attrs.frozen
class Counted(Event):
    """A folder is done."""

    folder: str = option(help="the folder")
    files: int = option(help="files in it")


EVENTS = (Counted,)


@pytest.mark.parametrize("event", [Counted("a", 2), Failed("a: is no folder")])
def test_declared_events_and_failures_are_read(event: Event) -> None:
    line = json.dumps({"event": type(event).__name__.lower(), **attrs.asdict(event)})
    assert read_event(line, EVENTS) == event


@pytest.mark.parametrize(
    ("facts", "message"),
    [
        ({"event": "counted", "folder": "a"}, "files: required key is missing"),
        ({"event": "counted", "folder": "a", "files": "2"}, "files: expected a whole number"),
        ({"event": "counted", "folder": "a", "files": 2, "bytes": 3}, "bytes: unknown key"),
        ({"event": "ended"}, "unknown event 'ended'; declared: counted, failed"),
        ({"event": None}, "unknown event 'None'"),
    ],
)
def test_a_line_of_another_shape_is_an_error(facts: dict[str, Any], message: str) -> None:
    with pytest.raises(WireError, match=message):
        read_event(json.dumps(facts), EVENTS)


@pytest.mark.parametrize("line", ['{"event": ', '{"event": "counted"', '{"event": ' + "[" * 100_000])
def test_a_damaged_line_is_an_error(line: str) -> None:
    with pytest.raises(WireError, match="malformed event"):
        read_event(line, EVENTS)


@pytest.mark.parametrize("line", ["", "begins", '{"other": 1}', "error: no"])
def test_other_output_is_no_event(line: str) -> None:
    assert read_event(line, EVENTS) is None
