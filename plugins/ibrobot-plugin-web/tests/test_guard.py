"""Attacks on the guard and on the commands of pages, with the application in this process."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
from collections.abc import Awaitable, Callable, Iterator, Mapping
from typing import Any, override
from unittest.mock import patch

import aiohttp
import pytest
from ibrobot_http.server import HttpServer, ServerThread
from ibrobot_testing.http import HttpSuite, Served
from ibrobot_web.messages import LARGEST_MESSAGE, Abandoned, Call, Jog, Release, RunCommand, Sent, clock_ms
from ibrobot_web.options import WebOptions
from ibrobot_web.server.app import make_app
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Drive
from ibrobot_web.server.page_guard import page_guard

Reply = Callable[[Mapping[str, Any]], None]


class Server:
    """A server whose run answers every command with its name."""

    def __init__(self, password: str | None = None) -> None:
        self.guard = page_guard(WebOptions(port=0, password=password), any_port="0")
        self.executed: list[RunCommand] = []
        self.released = self.stopped = 0
        self.broadcast = Broadcast(lambda: None, frozenset({1}))
        self.drive = Drive(self._execute, self._stop, self._release)
        self.base = self.guard.listener.url

    def _execute(self, sent: Sent[RunCommand], answer: Reply) -> None:
        self.executed.append(sent.command)
        answer({"ok": type(sent.command).__name__})

    def _stop(self, answer: Reply) -> None:
        self.stopped += 1
        answer({"ok": None})

    def _release(self) -> None:
        self.released += 1

    async def __aenter__(self) -> Server:
        app = make_app(self.guard, self.broadcast, self.drive, no_scene)
        self._server = await HttpServer(self.guard, app, close_s=0.1).__aenter__()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._server.__aexit__(None, None, None)

    def browser(self) -> aiohttp.ClientSession:
        cookies = aiohttp.CookieJar(unsafe=True)
        return aiohttp.ClientSession(self.base, cookie_jar=cookies, headers={"Origin": self.base})

    async def signed_in(self, browser: aiohttp.ClientSession, role: Any = "drive") -> None:
        async with browser.get(self.guard.path(role)) as answer:
            assert answer.status == 200
            assert "token" not in str(answer.url)


def run(test: Callable[[Server], Awaitable[None]], **options: Any) -> None:
    async def inside() -> None:
        async with Server(**options) as server:
            await test(server)

    asyncio.run(asyncio.wait_for(inside(), 120))


async def call(socket: aiohttp.ClientWebSocketResponse, **message: Any) -> dict[str, Any]:
    """Send a command and wait for its answer."""
    await socket.send_json({"id": 1, **message})
    while True:
        answer: dict[str, Any] = await socket.receive_json(timeout=60)
        if answer.get("id") == 1:
            return answer


def jog() -> dict[str, Any]:
    return {"do": "jog", "at": 2, "press": 1}


MALFORMED = 2_000
MODE = {"do": "call", "service": "/set_mode", "request": "a"}


async def no_scene() -> bytes:
    return b"{}"


class TestAttacks(HttpSuite):
    """What every server here withstands, on the routes of the page of a run."""

    password: str | None = None

    @override
    @contextlib.contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        with patch("ibrobot_http.guard.REQUEST_S", request_s), patch("ibrobot_http.guard._TRY_S", 0.0):
            guard = page_guard(WebOptions(port=0, password=self.password), any_port="0")
            broadcast = Broadcast(lambda: None, frozenset())
            drive = Drive(lambda sent, answer: None, lambda answer: answer({"ok": None}), lambda: None)
            server = ServerThread(guard, make_app(guard, broadcast, drive, no_scene), "page", close_s=0.1)
            with contextlib.closing(server):
                yield Served(
                    guard.listener.url,
                    ("/", "/api/session", "/api/scene", "/static/app.js"),
                    ("/api/stop",),
                    ("/stream", "/drive", "/stop"),
                    tuple(path for path in map(guard.path, ("drive", "watch")) if path != "/"),
                    password=self.password,
                )


class TestAttacksWithPassword(TestAttacks):
    """The same, where a password takes the place of the link for driving."""

    password = "correct horse battery"


def test_a_large_message_ends_the_connection() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as browser:
            await server.signed_in(browser)
            socket = await browser.ws_connect("/drive", max_msg_size=0)
            with contextlib.suppress(aiohttp.ClientError, ConnectionError):
                await socket.send_bytes(bytes(100 << 20))
            with contextlib.suppress(aiohttp.ClientError, ConnectionError):
                while (await socket.receive(timeout=60)).type is aiohttp.WSMsgType.TEXT:
                    pass
            assert socket.closed
            await socket.close()
        assert not server.executed

    run(test)


def test_malformed_messages_are_refused_and_harm_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_web.server.app._HEARTBEAT_S", 3600.0)  # the operator here answers no pings meanwhile
    wrong = [
        "", "null", "[]", "{}", '{"do": 1}', '{"do": "jog", "id": "x"}', '{"do": NaN}', "[" * 20000, "\x00", '{"do":',
        json.dumps({"do": "x" * (LARGEST_MESSAGE + 1)}),
    ]  # fmt: skip

    async def test(server: Server) -> None:
        async with server.browser() as browser, server.browser() as other:
            await server.signed_in(browser)
            await server.signed_in(other)
            operator = await other.ws_connect("/drive")
            await operator.receive_json(timeout=60)
            sent = 0
            while sent < MALFORMED:
                text = wrong[sent // 20 % len(wrong)]
                socket = await browser.ws_connect("/drive")
                with contextlib.suppress(ConnectionError):  # the server may end it while messages are sent
                    for _ in range(20):
                        sent += 1
                        await socket.send_str(text)
                        if len(text) > LARGEST_MESSAGE:
                            break
                    while (await socket.receive(timeout=60)).type is aiohttp.WSMsgType.TEXT:
                        pass
                await socket.close()
                if sent % 200 < 20:
                    assert (await call(operator, **MODE))["ok"] == "Call"
        assert set(server.executed) == {Call("/set_mode", "a")}
        assert server.drive.refused > 50

    run(test)


def test_only_the_operator_commands_and_taking_over_is_explicit() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as first, server.browser() as second, server.browser() as watcher:
            for browser in (first, second):
                await server.signed_in(browser)
            await server.signed_in(watcher, "watch")
            one, two = await first.ws_connect("/drive"), await second.ws_connect("/drive")
            three = await watcher.ws_connect("/drive")
            assert (await call(one, **MODE))["ok"] == "Call"
            assert "take over first" in (await call(two, **MODE))["error"]
            assert "take over explicitly" in (await call(two, do="operate"))["error"]
            for command in ({"do": "finish"}, jog(), {"do": "operate", "take_over": True}, MODE):
                assert "watching only" in (await call(three, **command))["error"]
            released = server.released
            assert "ok" in await call(two, do="operate", take_over=True)
            assert server.released == released + 1
            assert "take over first" in (await call(one, **jog()))["error"]
            assert (await call(two, **jog()))["ok"] == "Jog"
            released = server.released
            await two.close()
            await asyncio.sleep(0.05)
            assert server.released == released + 1
            assert server.drive.operator is None
            assert "ok" in await call(one, do="operate")

    run(test)


@pytest.mark.parametrize("then", ["goes on", "loads again and waits", "is gone"])
def test_the_run_learns_that_the_operators_page_is_gone(then: str, monkeypatch: pytest.MonkeyPatch) -> None:
    waits: list[Callable[[], None]] = []

    async def test(server: Server) -> None:
        loop = asyncio.get_running_loop()
        later = loop.call_later

        def call_later(seconds: float, act: Callable[..., None], *given: Any, **more: Any) -> Any:
            if act == server.drive._give_up:  # the wait ends when the test says so
                return waits.append(functools.partial(act, *given))
            return later(seconds, act, *given, **more)

        monkeypatch.setattr(loop, "call_later", call_later)
        async with server.browser() as browser:
            await server.signed_in(browser)
            socket = await browser.ws_connect("/drive")
            assert "ok" in await call(socket, **MODE)
            await socket.close()
            while not waits:
                await asyncio.sleep(0.01)
            if then != "is gone":
                again = await browser.ws_connect("/drive")
                await call(again, do="time")
                if then == "goes on":
                    await call(again, **MODE)
            waits[0]()
            assert (Abandoned() in server.executed) == (then != "goes on")

    run(test)


def test_every_page_that_may_drive_stops_the_robot_by_a_connection_of_its_own_or_a_request() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as first, server.browser() as second, server.browser() as watcher:
            for browser in (first, second):
                await server.signed_in(browser)
            await server.signed_in(watcher, "watch")
            await first.ws_connect("/drive")
            for count, browser in enumerate((first, second), 1):
                line = await browser.ws_connect("/stop")
                await line.send_str("7")
                assert await line.receive_json(timeout=60) == {"id": 7, "ok": None}
                async with browser.post("/api/stop") as answer:
                    assert (answer.status, await answer.json()) == (200, {"ok": None})
                assert server.stopped == 2 * count
            line = await watcher.ws_connect("/stop")
            await line.send_str("7")
            assert "watching only" in (await line.receive_json(timeout=60))["error"]
            async with watcher.post("/api/stop") as answer:
                assert answer.status == 400
            for headers in ({"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
                async with second.post("/api/stop", headers=headers) as answer:
                    assert answer.status == 403
            assert server.stopped == 4

    run(test)


@pytest.mark.parametrize("text", ["", "estop", '{"do": "estop"}', "-1", "1.5", "1" * 16, "²", "1 "])
def test_what_is_no_stop_is_refused_and_the_next_stop_works(text: str) -> None:
    async def test(server: Server) -> None:
        async with server.browser() as browser:
            await server.signed_in(browser)
            line = await browser.ws_connect("/stop")
            await line.send_str(text)
            assert await line.receive_json(timeout=60) == {"error": "expected a whole number"}
            await line.send_str("1")
            assert (await line.receive_json(timeout=60))["id"] == 1
            assert server.stopped == 1

    run(test)


def test_answers_say_the_time_that_messages_of_the_deadman_are_stamped_with() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as browser:
            await server.signed_in(browser)
            socket = await browser.ws_connect("/drive")
            before = clock_ms()
            answer = await call(socket, do="time")
            assert before <= answer["now"] <= clock_ms()
            assert (await call(socket, **jog()))["now"] >= answer["now"]
            await call(socket, do="release", at=5)
        assert server.executed == [Jog(2, 1), Release(5)]

    run(test)


def test_a_password_takes_the_place_of_the_token_and_cannot_be_tried_quickly() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as browser:
            async with browser.get("/") as answer:
                assert "Password" in await answer.text()
            statuses = []
            for password in ("wrong", "correct horse battery"):
                async with browser.post("/login", data={"password": password}, allow_redirects=False) as answer:
                    statuses.append(answer.status)
            assert statuses == [401, 429]
            await asyncio.sleep(1.1)
            async with browser.post("/login", data={"password": "correct horse battery"}) as answer:
                assert answer.status == 200
            async with browser.get("/api/session") as answer:
                assert (await answer.json())["role"] == "drive"

    run(test, password="correct horse battery")


def test_slow_pages_skip_frames_and_delay_nobody() -> None:
    async def test(server: Server) -> None:
        async with server.browser() as browser:
            await server.signed_in(browser)
            fast, slow = await browser.ws_connect("/stream"), await browser.ws_connect("/stream")
            got = []
            for i in range(200):
                server.broadcast.publish(0, i.to_bytes(2, "big"))
                got.append(int.from_bytes((await fast.receive_bytes(timeout=60))[1:], "big"))
                await fast.send_bytes(b"\x00")
            assert got == list(range(200))
            late = [int.from_bytes((await slow.receive_bytes(timeout=60))[1:], "big") for _ in range(2)]
            assert late == [0, 1], "without acknowledgements only the credits arrive"
            await slow.send_bytes(b"\x00")
            assert int.from_bytes((await slow.receive_bytes(timeout=60))[1:], "big") == 199

    run(test)
