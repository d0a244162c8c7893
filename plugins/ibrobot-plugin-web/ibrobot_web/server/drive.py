"""Commands of pages: one operator at a time, limits, and replies.

Commands have a WebSocket of their own, so that they never wait behind pictures.
"""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Callable, Mapping
from typing import Any

import attrs
from aiohttp import WSMsgType, web

from ibrobot_web.server.guard import Role

LARGEST_MESSAGE = 65536
"""Largest message of a page [bytes]."""
_MALFORMED = 20
"""Malformed messages after which a page is disconnected."""
_PER_SECOND = 100
"""Commands per second and page, on average."""
_BURST = 200
_OPEN_COMMANDS = 32
"""Commands of a page that may wait for their replies."""
OPEN_TO_ALL = frozenset({"estop", "release"})
"""Commands of every page that may drive, not of the operator alone."""


class CommandRefused(Exception):
    """A command that is refused, with the reason for the operator."""


@attrs.define(eq=False)
class Driver:
    """A page that may send commands."""

    number: int
    name: str
    role: Role
    socket: web.WebSocketResponse
    open: int = 0
    malformed: int = 0
    press: Any = None
    """The page's number of the deadman's last press."""
    allowance: float = _BURST
    counted_s: float = 0.0
    replies: asyncio.Queue[Mapping[str, Any]] = attrs.field(factory=lambda: asyncio.Queue(1024))


class Drive:
    """The pages that may send commands, and the operator among them.

    Args:
        execute: sends a command to the run, and calls back with its reply.
        release: releases the deadman of the operator.
    """

    def __init__(
        self,
        execute: Callable[[Mapping[str, Any], Callable[[Mapping[str, Any]], None]], None],
        release: Callable[[], None],
    ) -> None:
        self._execute = execute
        self._release = release
        self._drivers: dict[int, Driver] = {}
        self._numbers = itertools.count(1)
        self._presses = 0
        """Presses of the deadman on all pages, whose own numbers cannot be compared."""
        self.operator: Driver | None = None
        self.refused = 0
        """Number of refused messages."""

    def announce(self, **facts: Any) -> None:
        """Tell all pages who the operator is, with further facts."""
        for driver in self._drivers.values():
            self._reply(driver, {"event": "operator", **self._facts(driver), **facts})

    def _facts(self, driver: Driver) -> dict[str, Any]:
        operator = self.operator
        return {
            "page": driver.number,
            "role": driver.role,
            "operating": driver is operator,
            "operator": operator.name if operator is not None else "",
            "pages": len(self._drivers),
        }

    async def serve(self, socket: web.WebSocketResponse, role: Role, name: str) -> None:
        """Handle the commands of a page until it is gone."""
        number = next(self._numbers)
        driver = Driver(number, f"page {number} ({name})", role, socket)
        driver.counted_s = asyncio.get_running_loop().time()
        self._drivers[number] = driver
        if self.operator is None and role == "drive":
            self.operator = driver
        self.announce()
        sending = asyncio.create_task(self._send(driver))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT or not self._take(driver, message.data):
                    break
        finally:
            del self._drivers[number]
            if self.operator is driver:
                self.operator = None
                self._release()
            self.announce()
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await socket.close(code=1008 if driver.malformed >= _MALFORMED else 1000)

    async def _send(self, driver: Driver) -> None:
        while True:
            await driver.socket.send_str(json.dumps(await driver.replies.get(), separators=(",", ":")))

    def _take(self, driver: Driver, text: str) -> bool:
        """Handle a message; return whether to keep the page."""
        number: Any = None
        try:
            message = _parse(text)
            number = message.get("id")
            self._allow(driver)
            self._handle(driver, message, number)
        except CommandRefused as error:
            self._refuse(driver, number, str(error))
        except ValueError as error:
            driver.malformed += 1
            self._refuse(driver, number, str(error))
        return driver.malformed < _MALFORMED

    def _allow(self, driver: Driver) -> None:
        now_s = asyncio.get_running_loop().time()
        driver.allowance = min(_BURST, driver.allowance + (now_s - driver.counted_s) * _PER_SECOND)
        driver.counted_s = now_s
        if driver.allowance < 1.0:
            raise ValueError(f"more than {_PER_SECOND} commands per second")
        driver.allowance -= 1.0

    def _handle(self, driver: Driver, message: Mapping[str, Any], number: Any) -> None:
        do = message["do"]
        if driver.role != "drive":
            raise CommandRefused("this link is for watching only")
        if do == "operate":
            self._operate(driver, take_over=message.get("take_over") is True)
            self._reply(driver, {"id": number, "ok": None})
            return
        if do == "resign":
            if self.operator is driver:
                self.operator = None
                self._release()
                self.announce()
            self._reply(driver, {"id": number, "ok": None})
            return
        if do not in OPEN_TO_ALL and self.operator is not driver:
            operator = self.operator.name if self.operator is not None else "nobody"
            raise CommandRefused(f"this page only watches; the operator is {operator}: take over first")
        if do == "release" and self.operator is not driver:
            return
        if do == "jog":
            if message.get("press") != driver.press:
                driver.press = message.get("press")
                self._presses += 1
            message = {**message, "press": self._presses}
        if driver.open >= _OPEN_COMMANDS:
            raise CommandRefused("too many commands are waiting for their answers")
        if number is None:
            self._execute(message, lambda reply: None)
            return
        driver.open += 1

        def answer(reply: Mapping[str, Any]) -> None:
            driver.open -= 1
            self._reply(driver, {**reply, "id": number})

        self._execute(message, answer)

    def _operate(self, driver: Driver, *, take_over: bool) -> None:
        if self.operator is driver:
            return
        if self.operator is not None and not take_over:
            raise CommandRefused(f"{self.operator.name} is the operator: take over explicitly")
        self.operator = driver
        self._release()
        self.announce()

    def _refuse(self, driver: Driver, number: Any, why: str) -> None:
        self.refused += 1
        self._reply(driver, {"id": number, "error": why})

    @staticmethod
    def _reply(driver: Driver, reply: Mapping[str, Any]) -> None:
        try:
            driver.replies.put_nowait(reply)
        except asyncio.QueueFull:  # a page that does not read its replies
            driver.malformed = _MALFORMED


def _parse(text: str) -> Mapping[str, Any]:
    """A page's message.

    Raises:
        ValueError: if it is malformed.
    """
    try:
        message = json.loads(text, parse_constant=_no_constant)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"not JSON: {error}") from None
    if not isinstance(message, dict) or not isinstance(message.get("do"), str):
        raise ValueError("expected an object with a text `do`")
    if not isinstance(message.get("id"), int | None):
        raise ValueError("id must be a whole number")
    return message


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number in JSON")
