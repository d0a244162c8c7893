"""The component of the section: what agents may do, the server for them, and the log of what they did."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import AsyncIterator
from typing import override

from ibrobot_http.addresses import host_names
from ibrobot_http.listener import listen, tls_context
from ibrobot_terminal.authority import authority_of

from ibrobot_core.app import CONTROL, Pulse, RunView, SessionWorker
from ibrobot_mcp.audit import AuditFile
from ibrobot_mcp.options import McpOptions
from ibrobot_mcp.persons import Persons
from ibrobot_mcp.server import PIPES, AgentServer
from ibrobot_mcp.stdio import Pipes, serve_pipes
from ibrobot_mcp.tokens import tokens_folder
from ibrobot_mcp.web import http_server
from ibrobot_mcp.work import WorkServices

_CHECK_S = 0.02
"""Interval at which the authority of an agent is checked [s]."""
_BLOCKED_S = 2.0
"""Time without a sign of life of the server's thread after which the run ends [s]."""
_START_S = 10.0


class AgentDoor(SessionWorker):
    """Serves agents, over HTTP and, for `ibrobot mcp`, over pipes.

    Attributes:
        pipes: standard input and output of `ibrobot mcp`; set before the start.
        url: address for agents, once started; empty without HTTP.
    """

    sends_stops = True

    def __init__(self, options: McpOptions | None, session: RunView) -> None:
        self._options = options or McpOptions()
        where = f"port {self._options.port or 'any'}" if self._options.http else "standard input and output"
        super().__init__(session, "agents", f"a door for agents on {where}", (CONTROL,))
        self._authority = authority_of(session)
        self.pipes: Pipes | None = None
        self.url = ""

    @override
    def setup(self) -> None:
        self._audit = AuditFile(self.session)
        self.on_end.callback(self._audit.close)
        self._authority.open()
        self.on_end.callback(self._authority.close)
        self.on_end.callback(WorkServices(self.session).close)
        persons = Persons(self.session)
        self.on_end.callback(persons.close)
        thread = _ServerThread(self)
        self.on_end.callback(thread.close)
        where = f"{self.url}, each with a token by `ibrobot agent add NAME`" if self.url else "standard input"
        self.session.log.info("agents connect to %s; grant one authority by `ibrobot agent arm`", where)

    @override
    def work(self, timeout_s: float) -> None:
        self._authority.check()
        if trouble := self._audit.trouble:
            self._authority.end(trouble)
        if timeout_s > 0:
            self.pause(min(timeout_s, _CHECK_S))

    @contextlib.asynccontextmanager
    async def serving(self, server: AgentServer) -> AsyncIterator[None]:
        """Serve agents until the block ends."""
        async with contextlib.AsyncExitStack() as stack:
            if self._options.http:
                tokens_folder()  # a folder that others may enter is said now: later, nobody has a token
                options = self._options
                tls = None
                if options.certificate is not None and options.key is not None:
                    tls = tls_context(options.certificate, options.key, of="mcp: ")
                names = host_names(options.host, options.names)
                listener = listen(options.host, options.port, names, tls=tls, of="mcp: ", any_port="port: 0")
                self.url = f"{listener.url}/mcp"
                await stack.enter_async_context(http_server(server, listener))
            yield

    async def serve_pipes(self, server: AgentServer) -> None:
        """Serve the agent at the pipes, and end the run when it is gone."""
        if self.pipes is not None:
            await serve_pipes(server.protocol, self.pipes)
            await server.leave(PIPES)
            self.session.log.info("the agent has closed its connection: the run ends")
            self.session.finish()


class _ServerThread:
    """Runs the server in a thread of its own, until `close`."""

    def __init__(self, door: AgentDoor) -> None:
        self._door = door
        self._ending = asyncio.Event()
        self._started = threading.Event()
        self._failure: Exception | None = None
        self._pulse = Pulse("server for agents", _BLOCKED_S)
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._loop = self._runner.get_loop()
        self._thread = threading.Thread(target=self._run, name="agents", daemon=True)
        self._thread.start()
        self._started.wait(_START_S)
        if self._failure is not None:
            self._thread.join()
            raise self._failure

    def close(self) -> None:
        """Stop the server. Safe to call twice."""
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join()

    def _run(self) -> None:
        session = self._door.session
        try:
            with self._runner as runner:
                runner.run(self._serve())
        except Exception as error:  # noqa: BLE001 - reported to the run, which ends: an agent's stop would not be heard
            if not self._started.is_set():
                self._failure = error
            else:
                session.fail("agents", error)
        finally:
            session.pulses.discard(self._pulse)
            self._started.set()

    async def _serve(self) -> None:
        door, session = self._door, self._door.session
        server = AgentServer(session)
        try:
            async with door.serving(server):
                session.pulses.add(self._pulse)
                self._started.set()
                work = (server.ping(), server.check_tokens(), self._beat(), door.serve_pipes(server))
                tasks = [asyncio.create_task(each) for each in work]
                ending = asyncio.create_task(self._ending.wait())
                await _first_failure(ending, tasks)
        finally:
            await server.close()

    async def _beat(self) -> None:
        while True:
            self._pulse.beat()
            await asyncio.sleep(_BLOCKED_S / 8)


async def _first_failure(ending: asyncio.Task[bool], tasks: list[asyncio.Task[None]]) -> None:
    """Wait for the end, or for a task that fails; cancel the others."""
    waiting: set[asyncio.Task[object]] = {ending, *tasks}
    try:
        while not ending.done():
            done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                each.result()
    finally:
        for each in (ending, *tasks):
            each.cancel()
        await asyncio.gather(ending, *tasks, return_exceptions=True)
