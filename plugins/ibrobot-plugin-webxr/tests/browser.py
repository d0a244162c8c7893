"""A page in place of a browser's: logs in, sends messages, and collects answers, in a thread of its own."""

from __future__ import annotations

import asyncio
import itertools
import json
import ssl
import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import aiohttp

UNCHECKED = ssl.create_default_context()
UNCHECKED.check_hostname = False
UNCHECKED.verify_mode = ssl.CERT_NONE
_WAIT_S = 60.0


def hand(**changes: Any) -> dict[str, Any]:
    """A hand in a message."""
    plain = {"position": [0, 1, 0], "orientation": [0, 0, 0, 1], "clutch": False, "gripper": None, "open": 0}
    return {**plain, "move": [0, 0, 0], **changes}


_page_time = itertools.count(10, 10)
"""Its clock runs faster than any machine is slow, so that no pose counts as late."""


def hands(n: int = 1, **poses: Any) -> dict[str, Any]:
    """A message with hands."""
    return {"type": "hands", "n": n, "t": next(_page_time), "heading": 0, "hands": poses}


class Browser:
    """Connects to a page by the printed address.

    Args:
        address: the address with the token.
        headers: further headers of every request.
    """

    def __init__(self, address: str, **headers: str) -> None:
        parts = urlsplit(address)
        self.base = f"https://{parts.netloc}"
        self.received: list[dict[str, Any]] = []
        self.images: list[bytes] = []
        self._address = address
        self._headers = headers
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        self._session = self._run(self._open())
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._reading: asyncio.Task[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.disconnect()
        self._run(self._session.close())
        self._run(asyncio.sleep(0.05))  # closes connections
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _run(self, task: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(task, self._loop).result(_WAIT_S)

    async def _open(self) -> aiohttp.ClientSession:
        return aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(ssl=UNCHECKED), cookie_jar=aiohttp.CookieJar(unsafe=True)
        )

    def get(self, path: str, *, method: str = "GET", **headers: str) -> tuple[int, str, Mapping[str, str]]:
        """Status, text and headers of an answer; redirects are not followed."""

        async def ask() -> tuple[int, str, Mapping[str, str]]:
            asked = self._session.request(
                method, self.base + path, headers={**self._headers, **headers}, allow_redirects=False
            )
            async with asked as answer:
                return answer.status, await answer.text(), dict(answer.headers)

        return self._run(ask())

    def log_in(self) -> Self:
        status, _, _ = self.get(self._address.removeprefix(self.base))
        assert status == 303
        return self

    def connect(self, **headers: str) -> Self:
        """Open the socket.

        Raises:
            aiohttp.WSServerHandshakeError: if it is refused.
        """
        origin = {"Origin": self.base, **self._headers, **headers}
        self._socket = self._run(self._session.ws_connect(self.base + "/socket", headers=origin))
        self._reading = self._run(self._begin())
        return self

    async def _begin(self) -> asyncio.Task[None]:
        return asyncio.ensure_future(self._read())

    async def _read(self) -> None:
        assert self._socket is not None
        async for message in self._socket:
            if message.type is aiohttp.WSMsgType.TEXT:
                self.received.append(json.loads(message.data))
            elif message.type is aiohttp.WSMsgType.BINARY:
                self.images.append(message.data)

    def disconnect(self) -> None:
        if self._socket is not None:
            self._run(self._socket.close())
            self._socket = None
        if self._reading is not None:
            self._reading.cancel()

    @property
    def is_connected(self) -> bool:
        return self._socket is not None and not self._socket.closed

    def send(self, message: Mapping[str, Any] | str | bytes) -> None:
        assert self._socket is not None
        if isinstance(message, bytes):
            self._run(self._socket.send_bytes(message))
        else:
            self._run(self._socket.send_str(message if isinstance(message, str) else json.dumps(message)))

    def wait_for(self, found: Any) -> dict[str, Any]:
        """The first message received from now on that `found` accepts."""
        first = len(self.received)
        deadline = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline:
            for message in self.received[first:]:
                if found(message):
                    return message
            time.sleep(0.005)
        raise AssertionError(f"no such message; the last: {self.received[-3:]}")

    def state(self, **values: Any) -> dict[str, Any]:
        """The next state with some values."""
        return self.wait_for(lambda message: message["type"] == "state" and values.items() <= message.items())

    def send_hands(self, n: int, **poses: Mapping[str, Any]) -> None:
        """Send hands, and wait until the robot has taken them."""
        first = len(self.received)
        self.send(hands(n, **poses))
        deadline = time.monotonic() + _WAIT_S
        while time.monotonic() < deadline:
            if {"type": "echo", "n": n} in self.received[first:]:
                return
            time.sleep(0.002)
        raise AssertionError("no answer")
