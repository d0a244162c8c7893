"""`ibrobot camera preview`: shows cameras in a browser, on this machine or through an SSH tunnel."""

from __future__ import annotations

import asyncio
import html
import threading
from collections.abc import Mapping
from contextlib import closing, suppress
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import SensorError, option
from ibrobot_core.app import echo, on_signals

if TYPE_CHECKING:
    from aiohttp import web

    from ibrobot_camera.camera import OpenCvCamera

_BOUNDARY = "picture"
_STYLE = """body { margin: 1em; background: #111; color: #eee; font-family: sans-serif }
body { display: flex; flex-wrap: wrap; gap: 1em }
figure { margin: 0 } img { max-width: 100%; min-width: 20em; background: #333 }"""
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><title>ibrobot cameras</title>
<link rel="stylesheet" href="{style}">{figures}</html>"""


class Newest:
    """The newest image of one camera as a JPEG, for any number of viewers."""

    def __init__(self, name: str, camera: OpenCvCamera, ended: threading.Event) -> None:
        self.name = name
        self._camera = camera
        self._ended = ended
        self._changed = threading.Condition()
        self._jpeg = b""
        self._number = 0
        self.problem = ""
        self.thread = threading.Thread(target=self._run, name=f"preview {name}", daemon=True)

    def after(self, number: int, timeout_s: float) -> tuple[int, bytes]:
        """The first image newer than `number`, with its number; empty if none arrived in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout_s)
            return (self._number, self._jpeg) if self._number > number else (number, b"")

    def _run(self) -> None:
        from ibrobot_camera.commands.sources import browser_jpeg

        while not self._ended.is_set():
            try:
                image = self._camera.read(0.2)
            except SensorError as error:
                self.problem = str(error)
                self._ended.set()
                return
            if image is None:
                continue
            jpeg = browser_jpeg(image)
            with self._changed:
                self._jpeg, self._number = jpeg, self._number + 1
                self._changed.notify_all()


@attrs.frozen(kw_only=True)
class Preview:
    """Show the cameras of SOURCE in a browser.

    Prints the page's address, which contains a secret token. Without --host, only this machine can open it. To open it
    from another machine, set --port and run `ssh -L 8000:127.0.0.1:PORT robot`. Ctrl-C ends it.
    """

    source: str = option(typed="SOURCE", help="a device, or a robot YAML")
    host: str = option("127.0.0.1", help="address to listen on")
    port: int = option(0, ge=0, le=65535, help="0: any free port")
    seconds: float | None = option(None, ge=0, help="stop after this many seconds")

    def __call__(self) -> None:
        from ibrobot_http.addresses import host_names
        from ibrobot_http.guard import Guard
        from ibrobot_http.listener import listen
        from ibrobot_http.server import ServerThread

        from ibrobot_camera.commands.sources import opened

        ended = threading.Event()
        on_signals(ended.set)
        with opened(self.source) as cameras:
            listener = listen(self.host, self.port, host_names(self.host, ()), any_port="--port 0")
            guard = Guard(listener, roles=("watch",), any_port=True)
            views = {name: Newest(name, camera, ended) for name, camera in cameras.items()}
            with closing(ServerThread(guard, _app(views, ended), "preview")):
                for view in views.values():
                    view.thread.start()
                echo(guard.link("watch"))
                ended.wait(self.seconds)
                ended.set()
            for view in views.values():
                view.thread.join()
        for view in views.values():
            if view.problem:
                raise SensorError(view.problem)


def _app(views: Mapping[str, Newest], ended: threading.Event) -> web.Application:
    """The page, and a stream of pictures for each camera."""
    from aiohttp import web
    from ibrobot_http.files import STYLE

    async def page(request: web.Request) -> web.StreamResponse:
        figures = "".join(
            f'<figure><img src="/stream/{i}" alt="{name}"><figcaption>{name}</figcaption></figure>'
            for i, name in enumerate(map(html.escape, views))
        )
        return web.Response(text=_PAGE.format(style=STYLE, figures=figures), content_type="text/html")

    async def style(request: web.Request) -> web.StreamResponse:
        return web.Response(text=_STYLE, content_type="text/css")

    async def stream(request: web.Request) -> web.StreamResponse:
        number = int(request.match_info["number"])
        if number >= len(views):
            raise web.HTTPNotFound
        view, seen = list(views.values())[number], 0
        response = web.StreamResponse(headers={"Content-Type": f"multipart/x-mixed-replace; boundary={_BOUNDARY}"})
        await response.prepare(request)
        with suppress(ConnectionResetError):  # the browser has closed the page
            while not ended.is_set():
                seen, jpeg = await asyncio.to_thread(view.after, seen, 0.5)
                if jpeg:
                    head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                    await response.write(head.encode() + jpeg + b"\r\n")
        return response

    app = web.Application()
    app.router.add_get("/", page)
    app.router.add_get(STYLE, style)
    app.router.add_get(r"/stream/{number:\d+}", stream)
    return app
