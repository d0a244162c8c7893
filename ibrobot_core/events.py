"""Events: what a command tells the program that started it, one line of JSON each.

A command declares the classes of its events (`Command.events`) and prints them with `--events`. A program that started
it, such as a page, reads each line as an object of its class, and shows what `shown` returns: it needs no words of its
own. A line of another shape is an error.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping

import attrs

from ibrobot_core.options import option


@attrs.frozen
class Shown:
    """An event in words for a person."""

    text: str = ""
    """The state of the work; empty if the event does not change it."""
    progress: float | None = None
    """Share of the work that is done, 0 to 1."""
    problem: str = ""
    """What went wrong with a part of the work, which goes on."""
    point: Mapping[str, float] = attrs.field(factory=dict)
    """The next point of a curve, abscissa first, e.g. `{"step": 100, "loss": 0.7}`."""
    made: Mapping[str, str] = attrs.field(factory=dict)
    """Paths of what the work has made, by kind as in the `names` of `option`, e.g. `dataset`."""


@attrs.frozen
class Event:
    """Base of the events of commands: frozen attrs classes, whose fields (`option`) are plain data."""

    def shown(self) -> Shown:
        """The event in words for a person; by default none."""
        return Shown()


type Emit = Callable[[Event], None] | None
"""Prints an event of a command; None without `--events`."""


@attrs.frozen
class Failed(Event):
    """The last event of a command that ends with an error."""

    error: str = option(help="the reason, as on a terminal")


def encode_event(event: Event) -> str:
    """An event as a line of JSON, with the name of its class in lower case."""
    return json.dumps({"event": type(event).__name__.lower(), **attrs.asdict(event)}, allow_nan=False)
