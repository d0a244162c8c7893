"""A narrow network: a TCP proxy with a rate, a latency and a cut, shared by all connections."""

from __future__ import annotations

import asyncio
import contextlib

_CHUNK = 65536


class SlowLink:
    """Passes connections on to a port. What is sent queues in order, as in a network, however many connections send.

    Args:
        port: the port of the server on this machine.

    Attributes:
        port: the proxy's own port.
        up_per_s: rate from clients to the server [bytes/s]; None for no limit.
        latency_s: latency in each direction [s].
        cut: whether nothing passes any more.
    """

    def __init__(self, port: int) -> None:
        self._target = port
        self.port = 0
        self.up_per_s: float | None = None
        self.latency_s = 0.0
        self.cut = False
        self._free_s = 0.0
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> SlowLink:
        self._server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target)
        up = asyncio.create_task(self._pass(reader, far_writer, limited=True))
        down = asyncio.create_task(self._pass(far_reader, writer, limited=False))
        try:
            await asyncio.wait((up, down), return_when=asyncio.FIRST_COMPLETED)
        finally:
            for each in (up, down):
                each.cancel()
            await asyncio.gather(up, down, return_exceptions=True)
            for end in (writer, far_writer):
                end.close()
                with contextlib.suppress(OSError):
                    await end.wait_closed()
            self._tasks.discard(task)

    async def emptied(self) -> None:
        """Wait until nobody is connected any more."""
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *, limited: bool) -> None:
        loop = asyncio.get_running_loop()
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()
        delivering = asyncio.create_task(self._deliver(waiting, writer))
        try:
            while part := await reader.read(_CHUNK):
                at_s = loop.time()
                if limited and self.up_per_s is not None:
                    self._free_s = at_s = max(at_s, self._free_s) + len(part) / self.up_per_s
                waiting.put_nowait((at_s + self.latency_s, part))
            await waiting.join()
        finally:
            delivering.cancel()
            await asyncio.gather(delivering, return_exceptions=True)

    async def _deliver(self, waiting: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        while True:
            at_s, part = await waiting.get()
            await asyncio.sleep(max(0.0, at_s - loop.time()))
            while self.cut:
                await asyncio.sleep(0.01)
            with contextlib.suppress(ConnectionError):
                writer.write(part)
                await writer.drain()
            waiting.task_done()
