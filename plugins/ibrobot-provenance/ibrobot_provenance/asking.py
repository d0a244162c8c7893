"""Questions of jobs to an operator, as events of a command, and their answers."""

from __future__ import annotations

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import Event


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
