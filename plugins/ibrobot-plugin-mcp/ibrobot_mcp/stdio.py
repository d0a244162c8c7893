"""The protocol over the pipes of `ibrobot mcp`: one JSON object in each line, and none that is too long."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from typing import Any, override

import anyio
import attrs
import mcp_types as types
from mcp.server.lowlevel.server import Server
from mcp.shared.message import SessionMessage

LONGEST_LINE = 4 * 1024 * 1024
"""Longest line of an agent [bytes]; a longer one ends the connection."""
_UNREAD = 256
"""Messages that an agent may send without reading its answers, which fill the memory; more end the connection."""


@attrs.frozen
class Pipes:
    """Descriptors of an agent's pipes: what it writes, and what it reads."""

    source: int
    sink: int


def take_standard_pipes() -> Pipes:
    """Take standard input and output for the protocol: what else is printed goes to standard error from now on."""
    pipes = Pipes(os.dup(0), os.dup(1))
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return pipes


_log = logging.getLogger("ibrobot.mcp")


class _Sink(asyncio.streams.FlowControlMixin):
    """What the agent reads, until it is `closed`."""

    def __init__(self) -> None:
        super().__init__()
        self.closed = asyncio.Event()

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.closed.set()


async def serve_pipes(server: Server[Any], pipes: Pipes) -> None:
    """Serve the agent at the pipes, until it closes one of them."""
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit=LONGEST_LINE)
    source, _ = await loop.connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(pipes.source, "rb", buffering=0)
    )
    transport, flow = await loop.connect_write_pipe(_Sink, os.fdopen(pipes.sink, "wb", buffering=0))
    sink = asyncio.StreamWriter(transport, flow, None, loop)
    to_server, from_agent = anyio.create_memory_object_stream[SessionMessage | Exception](0)
    to_agent, from_server = anyio.create_memory_object_stream[SessionMessage](0)

    drained = asyncio.Event()
    drained.set()

    async def read() -> None:
        unread = 0
        async with to_server:
            while line := await _line(reader):
                unread = 0 if drained.is_set() else unread + 1
                if unread > _UNREAD:
                    _log.warning("the agent does not read its answers: it is disconnected")
                    return
                try:
                    message: SessionMessage | Exception = SessionMessage(
                        types.jsonrpc_message_adapter.validate_json(line, by_name=False)
                    )
                except ValueError as error:
                    message = error
                await to_server.send(message)

    async def write() -> None:
        with contextlib.suppress(ConnectionError):  # the agent is gone
            async for each in from_server:
                text = each.message.model_dump_json(by_alias=True, exclude_unset=True)
                sink.write(text.encode() + b"\n")
                drained.clear()
                await sink.drain()
                drained.set()

    async def end() -> None:
        await flow.closed.wait()
        group.cancel_scope.cancel()

    try:
        async with anyio.create_task_group() as group:
            group.start_soon(read)
            group.start_soon(write)
            group.start_soon(end)
            await server.run(from_agent, to_agent, server.create_initialization_options())
            group.cancel_scope.cancel()
    finally:
        for stream in (to_server, from_agent, to_agent, from_server):
            stream.close()
        source.close()
        if transport.get_write_buffer_size():
            transport.abort()  # what the agent does not read would keep the pipe open
        sink.close()
        with anyio.CancelScope(shield=True):
            await flow.closed.wait()


async def _line(reader: asyncio.StreamReader) -> bytes:
    """The next line; empty at the end, and for a line that is too long."""
    try:
        return await reader.readuntil(b"\n")
    except asyncio.IncompleteReadError as error:
        return error.partial
    except (asyncio.LimitOverrunError, ConnectionError):
        return b""
