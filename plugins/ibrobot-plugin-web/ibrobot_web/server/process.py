"""The process of the page's server: `python -m ibrobot_web.server.process CHANNEL STREAM`, started by the viewer.

Its order has the `options` of the viewer and the `description` of the robot. It answers `{"url": …, "watch_url": …}`.
Later messages:

- to the run: what `ibrobot_web.messages.to_run` makes;
- to the server: `{"reply": N, "ok": … | "error": …}`.

States and pictures arrive on STREAM, as `ibrobot_web.link` defines. It ends when the run closes the channel.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_http.server import HttpServer

from ibrobot_core.app import Channel, read_options, run_child
from ibrobot_web.link import ALIVE_S, FIRST_PICTURE, STATUS
from ibrobot_web.messages import Alive, Pages
from ibrobot_web.options import WebOptions
from ibrobot_web.pictures import as_jpeg
from ibrobot_web.server.app import make_app
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Drive, RunLine
from ibrobot_web.server.page_guard import page_guard

_DRAIN_S = 0.5
"""Longest time until pages have the last status [s]."""
_log = logging.getLogger("ibrobot.web")


class RunLink:
    """The server's side of the run.

    Args:
        channel: to the run.
        order: the order of the run.

    Attributes:
        receive: passes on the replies of the run.
        ended: set when the run has ended.
    """

    def __init__(self, channel: Channel, order: Mapping[str, Any]) -> None:
        self._order = order
        self._scene: asyncio.Future[bytes] | None = None
        self.ended = asyncio.Event()
        self._line = RunLine(channel, self.ended.set)
        self.receive = self._line.receive
        self.broadcast = Broadcast(self._pages_changed, frozenset({STATUS}))
        self.drive = Drive(self._line.execute, self._line.stop, self._line.release)

    async def scene(self) -> bytes:
        """The robot's shapes, made once, in a thread that does not delay the end."""
        if self._scene is None:
            self._scene = asyncio.get_running_loop().create_future()
            threading.Thread(target=self._make_scene, args=(self._scene,), name="scene", daemon=True).start()
        return await asyncio.shield(self._scene)

    def _make_scene(self, made: asyncio.Future[bytes]) -> None:
        from ibrobot_web.scene import make_scene

        content = json.dumps(make_scene(self._order["description"]), separators=(",", ":")).encode()
        with contextlib.suppress(RuntimeError):  # the server has ended meanwhile
            made.get_loop().call_soon_threadsafe(made.set_result, content)

    async def relay(self, stream: Channel) -> None:
        """Broadcast the states and pictures of the run."""
        loop, arrived = asyncio.get_running_loop(), asyncio.Event()
        try:
            while not stream.closed:
                loop.add_reader(stream.fileno(), arrived.set)
                await arrived.wait()
                loop.remove_reader(stream.fileno())  # until these are sent, newer ones replace each other in the run
                arrived.clear()
                for frame in stream.receive():
                    picture = frame["channel"] >= FIRST_PICTURE
                    payload = await as_jpeg(frame.payload) if picture else frame.payload
                    self.broadcast.publish(frame["channel"], payload)
        finally:
            self.ended.set()

    def _pages_changed(self) -> None:
        self._line.send(Pages(len(self.broadcast.pages), self.broadcast.wanted))

    async def live(self) -> None:
        """Report to the run periodically that the server is alive."""
        while True:
            self._line.send(Alive())
            await asyncio.sleep(ALIVE_S)


async def serve(channel: Channel, stream: Channel, order: Mapping[str, Any]) -> None:
    """Serve until the run closes the channel.

    Raises:
        IbrobotError: if the port or the certificate cannot be used.
    """
    loop = asyncio.get_running_loop()
    link = RunLink(channel, order)
    options = read_options(WebOptions, order["options"], Path, {})
    guard = page_guard(options, of="viewer: ", any_port="--set viewer.port=0")
    async with HttpServer(guard, make_app(guard, link.broadcast, link.drive, link.scene)):
        loop.add_reader(channel.fileno(), link.receive)
        relaying = asyncio.create_task(link.relay(stream))
        living = asyncio.create_task(link.live())
        scene = asyncio.create_task(link.scene())  # so that the first page does not wait for it
        channel.send({"url": guard.link("drive"), "watch_url": guard.link("watch")})
        await link.ended.wait()
        await link.broadcast.drain(_DRAIN_S)  # the last status says that the run has ended
        loop.remove_reader(channel.fileno())
        tasks = (relaying, living, scene)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def run(channel: Channel, order: Mapping[str, Any], stream: int) -> None:
    """Run the process."""
    sys.path[:] = [path for path in sys.path if Path(path) != Path()]
    asyncio.run(serve(channel, Channel(socket.socket(fileno=stream)), order))


if __name__ == "__main__":
    sys.exit(run_child(run))
