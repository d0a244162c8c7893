"""A server: an application behind its guard, with limits against misbehaving clients."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import socket
import threading
import weakref
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from types import TracebackType
from typing import Any, Self, override

from aiohttp import web

from ibrobot_http import guard as guarding
from ibrobot_http.guard import Guard

_CLIENTS = 200
"""Maximum number of simultaneous connections; others are refused."""
_ANSWER_S = 30.0
"""Time in which a client must read an answer [s]."""
_LINGER_S = 1.0
"""Time to read the rest of a request after its answer [s]."""
_CLOSING_S = 0.05
"""Time for connections to close at the end [s]."""
_log = logging.getLogger("ibrobot.http")
_quiet = logging.getLogger("ibrobot.http.clients")
_quiet.setLevel(logging.CRITICAL)  # not a fault of the server: clients that send no HTTP


class HttpServer:
    """Serves an application while its context is entered.

    Connections on which no request arrives within `ibrobot_http.guard.REQUEST_S` are closed, and so are those whose
    client does not read its answer. Errors of handlers are logged, and answered without saying more.

    Args:
        guard: admits requests.
        app: the application.
        close_s: time for requests to end when the server does [s].
    """

    def __init__(self, guard: Guard, app: web.Application, *, close_s: float = 1.0) -> None:
        app.middlewares.insert(0, guard.middleware)
        app.middlewares.insert(0, _contained)
        app.on_response_prepare.append(guard.add_headers)
        self._listener = guard.listener
        self._runner = web.AppRunner(
            app,
            access_log=None,
            logger=_quiet,
            keepalive_timeout=guarding.REQUEST_S,
            lingering_time=_LINGER_S,
            shutdown_timeout=close_s,
        )
        self._server: asyncio.Server | None = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(_quiet_about_clients)
        await self._runner.setup()
        assert self._runner.server is not None
        tls = self._listener.tls
        self._door = _Door(self._listener.socket)
        self._server = await loop.create_server(
            self._runner.server,
            sock=self._door,
            ssl=tls,
            ssl_handshake_timeout=None if tls is None else guarding.REQUEST_S,
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._server is not None
        self._door.most = 0
        await asyncio.sleep(0)  # asyncio leaks connections whose server closes between their acceptance and transport
        self._server.close()
        await self._runner.cleanup()
        self._door.end_all()
        await asyncio.sleep(_CLOSING_S)


class ServerThread:
    """A server in a thread of its own, until `close`.

    Args:
        guard: admits requests.
        app: the application.
        name: of the thread.
        close_s: time for requests to end when the server does [s].
        beside: a further task in the server's loop.

    Attributes:
        loop: the server's loop.
    """

    def __init__(
        self, guard: Guard, app: web.Application, name: str, *, close_s: float = 1.0,
        beside: Callable[[], Coroutine[Any, Any, None]] | None = None,
    ) -> None:  # fmt: skip
        self._server = HttpServer(guard, app, close_s=close_s)
        self._beside = beside
        self._ending = asyncio.Event()
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self.loop = self._runner.get_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server. Safe to call twice."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self.loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()

    def _run(self) -> None:
        with self._runner as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        async with self._server, asyncio.TaskGroup() as group:
            beside = group.create_task(self._beside()) if self._beside is not None else None
            await self._ending.wait()
            if beside is not None:
                beside.cancel()


class _Door(socket.socket):
    """A listening socket that accepts `most` connections at a time, and ends further ones at once.

    Connections count from their first packet: so do those that never finish their TLS handshake. A descriptor is kept
    for one, e.g. one that sends an emergency stop, for when this process may open no more files.
    """

    __slots__ = ("_accepted", "_spare", "most")

    def __init__(self, opened: socket.socket) -> None:
        super().__init__(fileno=opened.detach())
        self.most = _CLIENTS
        self._accepted: weakref.WeakSet[socket.socket] = weakref.WeakSet()
        self._spare: list[int] = []
        self._keep_spare()

    def _keep_spare(self) -> None:
        with contextlib.suppress(OSError):
            if not self._spare:
                self._spare.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def _give_spare(self) -> bool:
        """Close the descriptor that is kept; return whether there was one."""
        if not self._spare:
            return False
        os.close(self._spare.pop())
        return True

    @override
    def accept(self) -> tuple[socket.socket, Any]:
        self._keep_spare()
        try:
            connection, address = super().accept()
        except OSError as error:
            if error.errno not in (errno.EMFILE, errno.ENFILE) or not self._give_spare():
                raise
            connection, address = super().accept()
        if sum(each.fileno() >= 0 for each in self._accepted) >= self.most:
            connection.close()
            raise ConnectionAbortedError
        self._accepted.add(connection)
        return connection, address

    def end_all(self) -> None:
        """End all connections: browsers keep theirs open, and a handshake may not have ended."""
        self._give_spare()
        for connection in self._accepted:
            with contextlib.suppress(OSError):  # it has ended
                connection.shutdown(socket.SHUT_RDWR)


@web.middleware
async def _contained(
    request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
) -> web.StreamResponse:
    """Answer in any case, and send the answer within `_ANSWER_S`."""
    try:
        response = await handler(request)
    except web.HTTPException as error:
        response = web.Response(status=error.status, text=f"{error.reason}\n")
        if "Allow" in error.headers:
            response.headers["Allow"] = error.headers["Allow"]
    except Exception:  # noqa: BLE001 - contained: what fails here must not end the server
        _log.exception("%s %s failed", request.method, request.path)
        response = web.Response(status=500, text="failed; see the log\n")
    if isinstance(response, web.WebSocketResponse) or request.transport is None:
        return response
    assert isinstance(request.transport, asyncio.Transport)
    request.transport.set_write_buffer_limits(0)  # so that what is written has been taken
    try:
        async with asyncio.timeout(_ANSWER_S):
            await response.prepare(request)
            await response.write_eof()
    except TimeoutError:
        _log.debug("a client does not read its answer")
        request.transport.abort()
    return response


def _quiet_about_clients(loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
    """Log all errors but connections broken by clients, e.g. in the handshake of TLS."""
    if "transport" in context or "protocol" in context:
        _log.debug("%s", context["message"], exc_info=context.get("exception"))
    else:
        loop.default_exception_handler(dict(context))
