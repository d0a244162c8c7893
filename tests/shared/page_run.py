"""A run with a page: `ibrobot launch` in a process of its own, and clients of its page."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

import aiohttp
from ibrobot_web.link import FIRST_PICTURE, STATE, STATUS
from ibrobot_web.messages import clock_ms

IBROBOT = (sys.executable, "-c", "from ibrobot_core.cli.main import main; main()")
_START_S = 60.0
_ANSWER_S = 30.0
_SMALL = ("fps=5", "width=160", "height=120")
SO101 = (
    "so101",
    "--sim",
    "--mode",
    "web",
    *(part for camera in ("top", "wrist") for each in _SMALL for part in ("--set", f"peripherals.{camera}.{each}")),
)
"""A simulated arm whose two cameras take little of the processor."""
_WEB = ("--web", "--set", "viewer.port=0", "--set", "viewer.browser=false")


@contextmanager
def page_run(*arguments: str, folder: Path | None = None, command: Sequence[str] = ("launch",)) -> Iterator[str]:
    """Run a robot with its page, and yield the address of the page.

    Args:
        arguments: of the command line.
        folder: the working directory.
        command: the command.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8") as log:
        run = subprocess.Popen(
            [*IBROBOT, *command, *arguments, *_WEB],
            cwd=folder,
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "CI": "1"},
        )
        try:
            yield _address(run, log)
        finally:
            run.send_signal(signal.SIGINT)
            try:
                run.wait(60)
            finally:
                run.kill()
                run.wait()


def _address(run: subprocess.Popen[bytes], log: Any) -> str:
    deadline_s = time.monotonic() + _START_S
    while time.monotonic() < deadline_s and run.poll() is None:
        log.seek(0)
        if (found := re.search(r"viewer: (\S+)", log.read())) is not None:
            return found[1]
        time.sleep(0.05)
    log.seek(0)
    raise AssertionError(f"the page did not come up: {log.read()}")


class PageClient:
    """A page without a browser: signs in, takes states, sends commands."""

    def __init__(self, browser: aiohttp.ClientSession) -> None:
        self._browser = browser
        self._number = 0
        self.states: list[Mapping[str, Any]] = []
        """All joint states that arrived, with their time of arrival `at_ns`."""
        self.pictures: list[tuple[int, int, int]] = []
        """Channel, stamp [ns] and time of arrival [ns] of all pictures."""
        self.status: Mapping[str, Any] = {}
        self.answers: dict[int, Mapping[str, Any]] = {}
        self.confirmed: dict[int, Mapping[str, Any]] = {}
        """Answers to emergency stops."""
        self.press_ms = 0
        """When the deadman's present press began."""

    async def start(self, address: str) -> None:
        """Sign in and connect."""
        async with self._browser.get(address) as answer:
            assert answer.status == 200
        base = self._base = str(answer.url).rstrip("/")
        self.drive = await self._browser.ws_connect(f"{base}/drive", origin=base)
        self.line = await self._browser.ws_connect(f"{base}/stop", origin=base)
        self.stream = await self._browser.ws_connect(f"{base}/stream", origin=base, max_msg_size=0)
        # A client answers the server's pings only while it receives.
        self._tasks = [
            asyncio.create_task(self._receive()),
            asyncio.create_task(self._listen(self.drive, self.answers)),
            asyncio.create_task(self._listen(self.line, self.confirmed)),
        ]

    def get(self, path: str) -> Any:
        """Request a file or a fact of the page."""
        return self._browser.get(self._base + path)

    def post(self, path: str, body: Any) -> Any:
        """Send something."""
        return self._browser.post(self._base + path, data=body)

    def connect(self, path: str) -> Any:
        """A WebSocket of its own."""
        return self._browser.ws_connect(self._base + path, origin=self._base)

    async def _receive(self) -> None:
        async for message in self.stream:
            data: bytes = message.data
            now_ns = time.time_ns()
            if data[0] == STATE:
                self.states.append({**json.loads(data[1:]), "at_ns": now_ns})
            elif data[0] >= FIRST_PICTURE:
                self.pictures.append((data[0], int.from_bytes(data[1:9], "little"), now_ns))
            elif data[0] == STATUS:
                self.status = json.loads(data[1:])
            await self.stream.send_bytes(data[:1])

    @staticmethod
    async def _listen(socket: aiohttp.ClientWebSocketResponse, answers: dict[int, Mapping[str, Any]]) -> None:
        async for message in socket:
            answer = json.loads(message.data)
            if "id" in answer and answer["id"] is not None:
                answers[answer["id"]] = answer

    async def call(self, do: str, **facts: Any) -> Any:
        """Send a command and return its result.

        Raises:
            RuntimeError: if it is refused.
        """
        self._number += 1
        number = self._number
        stops = self.states[-1]["stops"] if self.states else None
        await self.drive.send_json({"id": number, "do": do, "stops": stops, **facts})
        return await self._answer_in(self.answers, number)

    async def service(self, name: str, request: Any = None) -> Any:
        """Call a service of the run; as `call`."""
        return await self.call("call", service=name, request=request)

    @staticmethod
    async def _answer_in(answers: dict[int, Mapping[str, Any]], number: int) -> Any:
        async with asyncio.timeout(_ANSWER_S):
            while number not in answers:
                await asyncio.sleep(0.005)
        answer = answers.pop(number)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer.get("ok")

    async def until(self, met: Any, timeout_s: float = _ANSWER_S) -> None:
        """Wait until a condition is met."""
        async with asyncio.timeout(timeout_s):
            while not met():
                await asyncio.sleep(0.01)

    async def estop(self) -> float:
        """Stop the robot; return the time to the confirmation [s].

        Raises:
            RuntimeError: if it is not confirmed.
        """
        self._number += 1
        begun_s = time.monotonic()
        await self.line.send_str(str(self._number))
        await self._answer_in(self.confirmed, self._number)
        return time.monotonic() - begun_s

    def press(self) -> None:
        """Press the deadman anew."""
        self.press_ms = max(self.press_ms + 1, clock_ms())

    async def beat(self, **motion: Any) -> None:
        """Say once that the deadman is held."""
        await self.drive.send_json({"do": "jog", "at": clock_ms(), "press": self.press_ms, **motion})

    async def jog(self, seconds: float, **motion: Any) -> None:
        """Press the deadman and hold it for a time."""
        end = time.monotonic() + seconds
        self.press()
        while time.monotonic() < end:
            await self.beat(**motion)
            await asyncio.sleep(0.04)

    async def close(self) -> None:
        """Leave in an orderly way."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for socket in (self.drive, self.line, self.stream):
            await socket.close()

    def cut(self) -> None:
        """Break the connections, as a killed browser does."""
        for socket in (self.drive, self.line, self.stream):
            connection = socket._response.connection
            assert connection is not None
            assert connection.transport is not None
            connection.transport.abort()


@asynccontextmanager
async def client(address: str) -> AsyncIterator[PageClient]:
    """A connected page."""
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as browser:
        page = PageClient(browser)
        await page.start(address)
        try:
            yield page
        finally:
            await page.close()
