"""What commands tell the programs that started them: their events, and among these questions to an operator."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import Event, Failed, RequestError, WireError, read_options


@attrs.frozen(kw_only=True)
class Choice:
    """An answer that an operator can choose: by a button, or by one key."""

    key: str = option(help="the key, by the character that it types or its name, e.g. `enter`")
    text: str = option(help="what it does, in lower case")
    urgent: bool = option(False, help="whether it stops a robot")


@attrs.frozen(kw_only=True)
class Sight:
    """What a camera sees, beside a question about it."""

    camera: str = option(help="the camera")
    wanted: str = option("", help="file of a picture as which the scene has to look; empty without one")
    live: str = option("", help="file of the present picture, which the command replaces again and again; likewise")


@attrs.frozen(kw_only=True)
class Ask(Event):
    """A question to an operator, until it is answered or the next one comes.

    The answer is an `Answer`: a line of JSON on standard input.
    """

    ask: int = option(help="its number")
    text: str = option(help="the question")
    choices: tuple[Choice, ...] = option((), help="the possible answers; none if the operator types one")
    sights: tuple[Sight, ...] = option((), help="what cameras see")


@attrs.frozen(kw_only=True)
class Answer:
    """An answer, which a command that asks reads as a line of JSON from standard input."""

    ask: int = option(help="number of the question")
    answer: str = option(help="key of the choice, or the text")


def read_event(line: str, events: Sequence[type[Event]]) -> Event | None:
    """The event in a line of a command's output; None for other output.

    Args:
        line: the line.
        events: the classes of events that the command declares; `Failed` is one of every command's.

    Raises:
        WireError: for an event of no such class, or of another shape.
    """
    if not line.startswith('{"event": '):
        return None
    known = {kind.__name__.lower(): kind for kind in (*events, Failed)}
    try:
        facts = json.loads(line)
        name = str(facts.pop("event"))
        if name not in known:
            raise WireError(f"unknown event {name!r}; declared: {', '.join(known)}")
        event: Event = read_options(known[name], facts, Path, {})
    except (ValueError, RecursionError, RequestError) as error:
        raise WireError(f"malformed event: {error}: {line[:200]}") from None
    return event
