"""Messages of pages, and what travels between the page's server and the run.

A page sends JSON objects. The server reads each as an object of a class of this module, or refuses it, and passes only
such objects on to the run, in envelopes of its own that no page can forge. The run checks them as strictly as the
server does.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import RequestError, RequestLimits, Service

LARGEST_MESSAGE = 16_384
"""Largest message of a page [bytes]."""
_CLOCK = time.CLOCK_BOOTTIME if sys.platform == "linux" else time.CLOCK_MONOTONIC
_NS_PER_MS = 1_000_000
_LIMITS = RequestLimits(values=300, text=1000, depth=4)
_LARGEST = 2**53
"""Numbers of commands and times are smaller, so that JavaScript can count them."""
_FARTHEST_RAD = 1000.0
"""Positions beyond this are mistakes."""


def clock_ms() -> int:
    """The time that pages stamp their messages with, the same in the server and in the run [ms].

    It goes on while the machine is suspended, where the system can say so.
    """
    return clock_ns() // _NS_PER_MS


def clock_ns() -> int:
    """As `clock_ms` [ns]."""
    return time.clock_gettime_ns(_CLOCK)


def _within_one(instance: object, attribute: object, values: Mapping[str, float] | tuple[float, ...]) -> None:
    """Check speeds, which are fractions; a validator of attrs.

    Raises:
        ValueError: for a speed beyond.
    """
    given = values.values() if isinstance(values, Mapping) else values
    if not all(abs(value) <= 1.0 for value in given):
        raise ValueError("a speed must lie between -1 and 1")


def _plausible(instance: object, attribute: object, values: Mapping[str, float]) -> None:
    """Check positions; a validator of attrs.

    Raises:
        ValueError: for one that no joint has.
    """
    if not all(abs(value) <= _FARTHEST_RAD for value in values.values()):
        raise ValueError(f"a position must lie between -{_FARTHEST_RAD:g} and {_FARTHEST_RAD:g}")


@attrs.frozen(kw_only=True)
class Motion:
    """A motion while the deadman is held."""

    joints: Mapping[str, float] = option(
        factory=dict, validator=_within_one, help="joint -> fraction of its speed, -1 to 1"
    )
    targets: Mapping[str, float] = option(
        factory=dict, unit="rad", validator=_plausible, help="joint -> position that it approaches"
    )
    linear: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), validator=_within_one, help="fraction of the tool's speed along the axes of the base"
    )
    turn: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), validator=_within_one, help="fraction of the tool's speed of turning about its own axes"
    )
    pose: str = option("", help="named pose that all joints of the device approach")
    device: str = option("", help="the device that moves; empty: the only one of the mode")


@attrs.frozen
class Jog(Motion):
    """Moves the robot while the page's deadman is held: at most until the next one, and for a fraction of a second.

    Times are those of `clock_ms`. The page stamps with the earliest that its message can have by it, so that a message
    is never younger than it seems.
    """

    at: int = option(ge=0, lt=_LARGEST, unit="ms", help="when the page made this message")
    press: int = option(ge=0, lt=_LARGEST, unit="ms", help="when the present press of the deadman began")


@attrs.frozen
class Release:
    """Releases the deadman: presses that began earlier no longer count."""

    at: int | None = option(None, ge=0, lt=_LARGEST, unit="ms", help="when; by default now")


@attrs.frozen
class Reset:
    """Clears faults and the emergency stops that the page has seen."""


SERVICES = (
    "/set_mode", "/action_dispatcher/toggle_smoothing", "/intervene", "/planning/go_to", "/planning/cancel",
    "/record_episode/start", "/record_episode/stop", "/record_episode/redo", "/record_episode/discard",
    "/agent/arm", "/agent/disarm",
)  # fmt: skip
"""The services of a run that its operator may call from a page."""


def _is_offered(instance: object, attribute: object, name: str) -> None:
    """Check that pages may call a service; a validator of attrs.

    Raises:
        ValueError: if not.
    """
    if name not in SERVICES:
        raise ValueError(f"pages cannot call {name[:80]!r}; they can call: {', '.join(SERVICES)}")


@attrs.frozen
class Call:
    """Calls a service of the run, which reads the request."""

    service: str = option(validator=_is_offered, help="its name")
    request: Any = option(None, help="as the service takes it")


@attrs.frozen
class Preview:
    """Plans a motion without executing it."""

    goal: str = option(help="as `/planning/go_to` takes it")


@attrs.frozen
class Finish:
    """Ends the run."""


@attrs.frozen
class Abandoned:
    """Nobody operates any more. The server says so; no page can."""


@attrs.frozen
class Operate:
    """Makes the page the operator."""

    take_over: bool = option(False, help="whether to take over from another page")


@attrs.frozen
class Resign:
    """Makes the operator's page one that watches."""


@attrs.frozen
class AskTime:
    """Asks for the time of `clock_ms`, which every answer has."""


RunCommand = Jog | Release | Reset | Call | Preview | Finish | Abandoned
"""Commands that the run carries out."""
PageCommand = Jog | Release | Reset | Call | Preview | Finish | Operate | Resign | AskTime
"""Commands that pages may send."""
_COMMANDS: Mapping[str, Service[Any, None]] = {
    name: Service(name, kind, type(None), limits=_LIMITS)
    for name, kind in {
        "jog": Jog, "release": Release, "reset": Reset, "call": Call, "preview": Preview, "finish": Finish,
        "abandoned": Abandoned, "operate": Operate, "resign": Resign, "time": AskTime,
    }.items()
}  # fmt: skip
_NAMES = {service.request: name for name, service in _COMMANDS.items()}


@attrs.frozen
class Sent[C]:
    """A command, as its sender numbers it."""

    number: int | None
    """Number for the answer; None: no answer is wanted."""
    stops: int | None
    """Number of emergency stops that the sender had seen; None if it has seen no state of the robot."""
    command: C


@attrs.frozen
class StopRun:
    """An emergency stop, on its way to the run."""

    number: int


@attrs.frozen
class Pages:
    """How many pages there are, and which channels they show."""

    count: int
    wanted: frozenset[int] | None
    """None for all."""


@attrs.frozen
class Alive:
    """A sign of life of the server."""


FromServer = Sent[RunCommand] | StopRun | Pages | Alive
"""What the server sends to the run."""


def from_page(text: str) -> Sent[PageCommand]:
    """The command in a message of a page.

    Raises:
        MalformedMessage: if it is not valid, with its number if that is known.
    """
    message = _object(text)
    number = _whole(message, "id")
    try:
        stops = _whole(message, "stops")
        if not isinstance(name := message.get("do"), str):
            raise ValueError("expected an object with a text `do`")
        facts = {key: value for key, value in message.items() if key not in ("id", "stops", "do")}
        command = _read(name, facts)
        if not isinstance(command, PageCommand):
            raise ValueError(f"{name} is not for pages")
        return Sent(number, stops, command)
    except (ValueError, IbrobotError) as error:
        raise MalformedMessage(str(error), number) from None


def stop_from_page(text: str) -> int:
    """The number of an emergency stop in a message of a page, which is nothing else, so that it needs no time.

    Raises:
        MalformedMessage: if it is not valid.
    """
    if not (text.isascii() and text.isdecimal() and len(text) <= 15):
        raise MalformedMessage("expected a whole number")
    return int(text)


def to_run(message: FromServer) -> dict[str, Any]:
    """A message of the server for its channel."""
    match message:
        case Sent(number, stops, command):
            facts = attrs.asdict(command)
            return {"command": _NAMES[type(command)], "number": number, "stops": stops, "facts": facts}
        case StopRun(number):
            return {"stop": number}
        case Pages(count, wanted):
            return {"pages": count, "wanted": None if wanted is None else sorted(wanted)}
        case Alive():
            return {"alive": True}


def from_server(message: Mapping[str, Any]) -> FromServer:
    """A message of the server, in the run.

    Raises:
        ValueError: if it is not valid.
        RequestError: for an unknown command, or one whose facts do not fit.
    """
    match dict(message):
        case {"command": str() as name, "facts": dict() as facts, "number": _, "stops": _, **more} if not more:
            command = _read(name, facts)
            if not isinstance(command, RunCommand):
                raise ValueError(f"{name} is not for the run")
            return Sent(_whole(message, "number"), _whole(message, "stops"), command)
        case {"stop": int() as number, **more} if not more:
            return StopRun(number)
        case {"pages": int() as count, "wanted": list() | None as wanted, **more} if not more:
            channels = {each for each in wanted or () if isinstance(each, int)}
            return Pages(count, None if wanted is None else frozenset(channels))
        case {"alive": True, **more} if not more:
            return Alive()
    raise ValueError(f"invalid message of the page's server: {', '.join(map(str, message))[:80]}")


class MalformedMessage(IbrobotError):
    """A page has sent an invalid command.

    Attributes:
        number: the page's number of it, if that is known.
    """

    def __init__(self, why: str, number: int | None = None) -> None:
        super().__init__(why)
        self.number = number


def _object(text: str) -> dict[str, Any]:
    try:
        message = json.loads(text, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {error}") from None
    if not isinstance(message, dict):
        raise MalformedMessage("expected an object with a text `do`")
    return message


def _read(name: str, facts: Mapping[str, Any]) -> Any:
    if (service := _COMMANDS.get(name)) is None:
        raise RequestError(f"unknown command {name[:40]!r}; known: {', '.join(_COMMANDS)}")
    return service.read(facts)


def _whole(message: Mapping[str, Any], name: str) -> int | None:
    value = message.get(name)
    if value is None or (isinstance(value, int) and not isinstance(value, bool) and 0 <= value < _LARGEST):
        return value
    raise MalformedMessage(f"{name} must be a whole number")


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number in JSON")
