"""The application of `ibrobot ui` in this process, and a client that is signed in."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import aiohttp
from ibrobot_http.server import HttpServer
from ibrobot_provenance.processes import Jobs
from ibrobot_web.options import WebOptions
from ibrobot_web.server.page_guard import page_guard
from ibrobot_web.status import without_tokens
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.server import make_app

_WAIT_S = 30.0


class UiServer:
    """The server.

    Args:
        folders: the opened folders.
        port: the port; 0 for any free one.
    """

    def __init__(self, folders: Sequence[Path], port: int = 0) -> None:
        self.guard = page_guard(WebOptions(port=port), any_port="0")
        self.port = self.guard.listener.port
        opened = Folders(folders)
        options = ("--web", "--set", "viewer.port=0", "--set", "viewer.browser=false")
        self.ui = Ui(opened, Jobs(opened.first, without_tokens), options)
        self.client: aiohttp.ClientSession
        """Signed in as the operator."""
        self._base = self.guard.listener.url

    async def __aenter__(self) -> UiServer:
        self._server = await HttpServer(self.guard, make_app(self.guard, self.ui), close_s=0.1).__aenter__()
        self.client = self.browser()
        await self.sign_in(self.client)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.client.close()
        await self._server.__aexit__(None, None, None)
        await asyncio.to_thread(self.ui.close)

    @property
    def address(self) -> str:
        """The link for operators."""
        return self.guard.link("drive")

    def browser(self) -> aiohttp.ClientSession:
        """A client without a session."""
        cookies = aiohttp.CookieJar(unsafe=True)
        return aiohttp.ClientSession(self._base, cookie_jar=cookies, headers={"Origin": self._base})

    async def sign_in(self, browser: aiohttp.ClientSession, role: Any = "drive") -> None:
        """Open a session."""
        async with browser.get(self.guard.path(role)) as answer:
            assert answer.status == 200

    async def text(self, path: str) -> str:
        """A file of the page."""
        async with self.client.get(path) as answer:
            assert answer.status == 200, path
            return await answer.text()

    async def get(self, path: str, /, **query: str) -> Any:
        """The answer of a view, `VIEW/REQUEST`.

        Raises:
            RuntimeError: with the error that the page would show.
        """
        async with self.client.get(f"/api/{path}", params=query) as answer:
            return await _content(answer)

    async def post(self, path: str, /, **facts: Any) -> Any:
        """As `get`, with a POST."""
        async with self.client.post(f"/api/{path}", json=facts) as answer:
            return await _content(answer)

    async def job(self, met: Callable[[dict[str, Any]], bool], line: str = "") -> tuple[dict[str, Any], list[str]]:
        """Wait for a change of a job that meets a condition, and for a line; return the job and its lines."""
        lines: list[str] = []
        async with asyncio.timeout(_WAIT_S), self.client.ws_connect("/api/jobs") as socket:
            async for message in socket:
                change = json.loads(message.data)
                lines += change["lines"]
                if met(change["job"]) and (not line or line in lines):
                    return change["job"], lines
        raise AssertionError(f"the stream ended; lines: {lines}")


async def _content(answer: aiohttp.ClientResponse) -> Any:
    if answer.content_type != "application/json":
        return await answer.read()
    content = await answer.json()
    if answer.status != 200:
        raise RuntimeError(content["error"])
    return content


def run_ui(folders: Sequence[Path], test: Callable[[UiServer], Awaitable[None]]) -> None:
    """Run a test with a server."""

    async def inside() -> None:
        async with UiServer(folders) as server:
            await test(server)

    asyncio.run(asyncio.wait_for(inside(), 2 * _WAIT_S))
