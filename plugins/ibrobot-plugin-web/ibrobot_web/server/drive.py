"""Commands of pages: one operator at a time, limits, and replies; and the emergency stop, which has its own way.

Commands have a WebSocket of their own, so that they never wait behind pictures. The emergency stop has another one for
itself.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import json
from collections.abc import Callable, Mapping
from typing import Any

import attrs
from aiohttp import WSMsgType, web

from ibrobot_core.app import Channel
from ibrobot_web.messages import (
    Abandoned,
    AskTime,
    FromServer,
    Jog,
    MalformedMessage,
    Operate,
    PageCommand,
    Release,
    Resign,
    RunCommand,
    Sent,
    StopRun,
    clock_ms,
    from_page,
    stop_from_page,
    to_run,
)

_MALFORMED = 20
"""Malformed messages after which a page is disconnected."""
_PER_SECOND = 100
"""Commands per second and page, on average."""
_BURST = 200
_OPEN_COMMANDS = 32
"""Commands of a page that may wait for their replies."""
_ABANDONED_S = 5.0
"""Time in which nobody goes on after the operator's page was closed or loaded again; then comes `Abandoned` [s]."""
_STOP_S = 5.0
"""Longest wait for the confirmation of a stop that was sent as a request [s]."""

Answer = Callable[[Mapping[str, Any]], None]
"""Called with `ok` or `error`."""


class CommandRefused(Exception):
    """A refused command; the text is the reason for the operator."""


@attrs.define(eq=False)
class Driver:
    """A page that may send commands."""

    number: int
    name: str
    role: str
    socket: web.WebSocketResponse
    open: int = 0
    malformed: int = 0
    allowance: float = _BURST
    counted_s: float = 0.0
    replies: asyncio.Queue[Mapping[str, Any]] = attrs.field(factory=lambda: asyncio.Queue(1024))


class Drive:
    """The pages that may send commands, and the operator among them.

    Args:
        execute: sends a command to the run, and calls back with its reply.
        stop: sends an emergency stop to the run, and calls back with its reply.
        release: releases the deadman of the operator.
    """

    def __init__(
        self,
        execute: Callable[[Sent[RunCommand], Answer], None],
        stop: Callable[[Answer], None],
        release: Callable[[], None],
    ) -> None:
        self._execute = execute
        self._stop = stop
        self._release = release
        self._drivers: dict[int, Driver] = {}
        self._numbers = itertools.count(1)
        self.operator: Driver | None = None
        self._deserted = 0
        """Number of the operator's page that was closed last; 0 once another one has sent a command."""
        self.refused = 0
        """Number of refused messages."""

    def announce(self) -> None:
        """Tell all pages who the operator is."""
        for driver in self._drivers.values():
            self._reply(driver, {"event": "operator", **self._facts(driver)})

    def _facts(self, driver: Driver) -> dict[str, Any]:
        operator = self.operator
        return {
            "page": driver.number,
            "role": driver.role,
            "operating": driver is operator,
            "operator": operator.name if operator is not None else "",
            "pages": len(self._drivers),
        }

    async def serve(self, socket: web.WebSocketResponse, role: str, name: str) -> None:
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
                self._deserted = number
                asyncio.get_running_loop().call_later(_ABANDONED_S, self._give_up, number)
            self.announce()
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await socket.close(code=1008 if driver.malformed >= _MALFORMED else 1000)

    def _give_up(self, number: int) -> None:
        if self._deserted == number:
            self._execute(Sent(None, None, Abandoned()), lambda reply: None)

    async def serve_stop(self, socket: web.WebSocketResponse, role: str) -> None:
        """Pass on the emergency stops of a page until it is gone; each message is one, a number for its reply."""
        replies: asyncio.Queue[Mapping[str, Any]] = asyncio.Queue()
        sending = asyncio.create_task(_send_all(socket, replies))
        malformed = 0
        try:
            async for message in socket:
                try:
                    number = stop_from_page(message.data if message.type is WSMsgType.TEXT else "")
                except MalformedMessage as error:
                    malformed += 1
                    replies.put_nowait({"error": str(error)})
                    if malformed >= _MALFORMED:
                        break
                    continue
                self._stop_run(role, functools.partial(_put, replies, number))
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            await socket.close()

    async def stop_now(self, role: str) -> Mapping[str, Any]:
        """Pass on an emergency stop, and return the run's reply."""
        replied: asyncio.Future[Mapping[str, Any]] = asyncio.get_running_loop().create_future()
        self._stop_run(role, lambda reply: None if replied.done() else replied.set_result(reply))
        try:
            return await asyncio.wait_for(replied, _STOP_S)
        except TimeoutError:
            return {"error": f"the run did not confirm the stop within {_STOP_S:g} s"}

    def _stop_run(self, role: str, answer: Answer) -> None:
        if role == "drive":
            self._stop(answer)
        else:
            answer({"error": "this link is for watching only"})

    async def _send(self, driver: Driver) -> None:
        while True:
            reply = {**await driver.replies.get(), "now": clock_ms()}
            await driver.socket.send_str(json.dumps(reply, separators=(",", ":")))

    def _take(self, driver: Driver, text: str) -> bool:
        """Handle a message; return whether to keep the page."""
        number: int | None = None
        try:
            self._allow(driver)
            sent = from_page(text)
            number = sent.number
            self._handle(driver, sent)
        except CommandRefused as error:
            self._refuse(driver, number, str(error))
        except MalformedMessage as error:
            driver.malformed += 1
            self._refuse(driver, error.number, str(error))
        return driver.malformed < _MALFORMED

    def _allow(self, driver: Driver) -> None:
        now_s = asyncio.get_running_loop().time()
        driver.allowance = min(_BURST, driver.allowance + (now_s - driver.counted_s) * _PER_SECOND)
        driver.counted_s = now_s
        if driver.allowance < 1.0:
            raise MalformedMessage(f"more than {_PER_SECOND} commands per second")
        driver.allowance -= 1.0

    def _handle(self, driver: Driver, sent: Sent[PageCommand]) -> None:
        if driver.role != "drive":
            raise CommandRefused("this link is for watching only")
        match sent.command:
            case AskTime():
                self._reply(driver, {"id": sent.number, "ok": None})
            case Operate(take_over):
                self._operate(driver, take_over=take_over)
                self._reply(driver, {"id": sent.number, "ok": None})
            case Resign():
                self._resign(driver)
                self._reply(driver, {"id": sent.number, "ok": None})
            case Release() if self.operator is not driver:
                return
            case command:
                self._pass_on(driver, Sent(sent.number, sent.stops, command))

    def _pass_on(self, driver: Driver, sent: Sent[RunCommand]) -> None:
        if self.operator is not driver:
            operator = self.operator.name if self.operator is not None else "nobody"
            raise CommandRefused(f"this page only watches; the operator is {operator}: take over first")
        if not isinstance(sent.command, Release):
            self._deserted = 0
        if sent.number is None:
            self._execute(sent, lambda reply: None)
            return
        # The deadman's messages have a place beside the others, which may all wait.
        if driver.open >= _OPEN_COMMANDS and not isinstance(sent.command, Jog | Release):
            raise CommandRefused("too many commands are waiting for their answers")
        driver.open += 1

        def answer(reply: Mapping[str, Any]) -> None:
            driver.open -= 1
            self._reply(driver, {**reply, "id": sent.number})

        self._execute(sent, answer)

    def _operate(self, driver: Driver, *, take_over: bool) -> None:
        if self.operator is driver:
            return
        if self.operator is not None and not take_over:
            raise CommandRefused(f"{self.operator.name} is the operator: take over explicitly")
        self.operator = driver
        self._release()
        self.announce()

    def _resign(self, driver: Driver) -> None:
        if self.operator is driver:
            self.operator = None
            self._release()
            self.announce()

    def _refuse(self, driver: Driver, number: int | None, why: str) -> None:
        self.refused += 1
        self._reply(driver, {"id": number, "error": why})

    @staticmethod
    def _reply(driver: Driver, reply: Mapping[str, Any]) -> None:
        try:
            driver.replies.put_nowait(reply)
        except asyncio.QueueFull:  # a page that does not read its replies
            driver.malformed = _MALFORMED


class RunLine:
    """The line to the run: sends it commands and emergency stops, and calls back with its replies.

    Args:
        channel: to the run.
        on_end: called when the run has closed the channel.
    """

    def __init__(self, channel: Channel, on_end: Callable[[], None]) -> None:
        self._channel = channel
        self._on_end = on_end
        self._numbers = itertools.count(1)
        self._answers: dict[int, Answer] = {}

    def execute(self, sent: Sent[RunCommand], answer: Answer) -> None:
        """Send a command; without a number it has no reply."""
        self.send(sent if sent.number is None else attrs.evolve(sent, number=self._numbered(answer)))

    def stop(self, answer: Answer) -> None:
        """Send an emergency stop."""
        self.send(StopRun(self._numbered(answer)))

    def release(self) -> None:
        """Release the deadman of the operator."""
        self.send(Sent(None, None, Release()))

    def receive(self) -> None:
        """Pass on the replies that have arrived."""
        for message in self._channel.receive():
            match message:
                case {"reply": int() as number, "ok": value} if number in self._answers:
                    self._answers.pop(number)({"ok": value})
                case {"reply": int() as number, "error": str() as why} if number in self._answers:
                    self._answers.pop(number)({"error": why})
        if self._channel.closed:
            self._on_end()

    def send(self, message: FromServer) -> None:
        """Send a message."""
        self._channel.send(to_run(message))

    def _numbered(self, answer: Answer) -> int:
        number = next(self._numbers)
        self._answers[number] = answer
        return number


def _put(replies: asyncio.Queue[Mapping[str, Any]], number: int, reply: Mapping[str, Any]) -> None:
    replies.put_nowait({**reply, "id": number})


async def _send_all(socket: web.WebSocketResponse, replies: asyncio.Queue[Mapping[str, Any]]) -> None:
    while True:
        await socket.send_str(json.dumps(await replies.get(), separators=(",", ":")))
