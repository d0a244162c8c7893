"""The protocol over streamable HTTP: the application of the SDK behind the guard and limits of `ibrobot_http`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

import anyio
import anyio.to_thread
from aiohttp import web
from anyio.abc import TaskGroup, TaskStatus
from ibrobot_http.guard import Guard
from ibrobot_http.listener import Listener
from ibrobot_http.server import HttpServer
from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser
from mcp.server.auth.provider import AccessToken
from mcp.server.streamable_http_manager import StreamableHTTPSessionManager

from ibrobot_mcp.server import AgentServer, key_of
from ibrobot_mcp.tokens import agent_of

PATH = "/mcp"
_LARGEST = 1024 * 1024
"""Largest request [bytes]."""
_SESSIONS = 8
"""Most sessions of an agent, in the protocols that have some; more are refused with 503, and no other agent is."""
_IDLE_S = 600.0
"""Time without a request after which a session ends [s]."""
_NO_TOKEN = "this server needs `Authorization: Bearer TOKEN`; `ibrobot agent add NAME` makes the token of an agent\n"
_READS = 4
"""Tokens that are looked up at the same time."""


@contextlib.asynccontextmanager
async def http_server(server: AgentServer, listener: Listener) -> AsyncIterator[None]:
    """Serve agents over HTTP until the block ends."""
    reads = anyio.CapacityLimiter(_READS)

    async def answer(request: web.Request) -> web.StreamResponse:
        token = request.headers.get("Authorization", "").removeprefix("Bearer ")
        name = await anyio.to_thread.run_sync(agent_of, token, limiter=reads)
        if not name:
            return web.Response(status=401, text=_NO_TOKEN, headers={"WWW-Authenticate": "Bearer"})
        # The SDK lets nobody else use a session of this user.
        user = AuthenticatedUser(AccessToken(token=token, client_id=name, scopes=[]))
        manager = await managers.of(name)
        response = await _asgi(manager.handle_request, request, user)
        if request.method == "DELETE":
            await server.leave(key_of(name, request.headers.get("mcp-session-id", "")))
        return response

    app = web.Application(client_max_size=_LARGEST)
    for method in ("GET", "POST", "DELETE"):
        app.router.add_route(method, PATH, answer)
    async with anyio.create_task_group() as group:
        managers = _Managers(server, group)
        async with HttpServer(Guard(listener), app):
            yield
        group.cancel_scope.cancel()


class _Managers:
    """The sessions of each agent, which the SDK manages, so that none can take those of others.

    Args:
        server: answers the agents.
        group: in which they run.
    """

    def __init__(self, server: AgentServer, group: TaskGroup) -> None:
        self._server, self._group = server, group
        self._known: dict[str, StreamableHTTPSessionManager] = {}
        self._making = anyio.Lock()

    async def of(self, name: str) -> StreamableHTTPSessionManager:
        """The sessions of an agent."""
        async with self._making:
            if name not in self._known:
                self._known[name] = await self._group.start(self._run)
            return self._known[name]

    async def _run(self, *, task_status: TaskStatus[StreamableHTTPSessionManager]) -> None:
        manager = StreamableHTTPSessionManager(
            self._server.protocol, session_idle_timeout=_IDLE_S, max_sessions=_SESSIONS, max_request_body_size=_LARGEST
        )
        async with manager.run():
            task_status.started(manager)
            await anyio.sleep_forever()


async def _asgi(
    app: Callable[[Any, Any, Any], Awaitable[None]], request: web.Request, user: AuthenticatedUser
) -> web.StreamResponse:
    """The answer of an ASGI application to a request of a user."""
    body = await request.read()
    scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "method": request.method,
        "scheme": request.scheme,
        "path": request.path,
        "raw_path": request.path.encode(),
        "root_path": "",
        "query_string": request.query_string.encode(),
        "headers": [(name.lower(), value) for name, value in request.raw_headers],
        "user": user,
    }
    given = False
    response: web.StreamResponse | None = None

    async def receive() -> dict[str, Any]:
        nonlocal given
        if given:
            await _gone(request)
            return {"type": "http.disconnect"}
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: dict[str, Any]) -> None:
        with contextlib.suppress(ConnectionError):  # the agent is gone
            await pass_on(message)

    async def pass_on(message: dict[str, Any]) -> None:
        nonlocal response
        if message["type"] == "http.response.start":
            headers = [(name.decode("latin-1"), value.decode("latin-1")) for name, value in message.get("headers", ())]
            response = web.StreamResponse(status=message["status"])
            for name, value in headers:
                if name.lower() != "content-length":
                    response.headers.add(name, value)
            await response.prepare(request)
        elif message["type"] == "http.response.body":
            assert response is not None
            if message.get("body"):
                await response.write(message["body"])
            if not message.get("more_body"):
                await response.write_eof()

    await app(scope, receive, send)
    return response if response is not None else web.Response(status=500, text="no answer\n")


async def _gone(request: web.Request) -> None:
    """Wait until the client has closed its connection."""
    while request.transport is not None and not request.transport.is_closing():
        await asyncio.sleep(0.1)
