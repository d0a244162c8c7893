"""The web application: pages, their files, the stream of states and pictures, and the commands."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

from aiohttp import web

from ibrobot_web.messages import LARGEST_MESSAGE
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Drive
from ibrobot_web.server.guard import Guard

STATIC = Path(__file__).parents[1] / "static"
_HEARTBEAT_S = 5.0
"""Time between pings that find pages which are gone without a word [s]."""
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


class Files:
    """Serves the files of some folders, each by its name: no path of a request reaches the file system.

    Args:
        folders: prefix of the URL -> folder.
    """

    def __init__(self, folders: dict[str, Path]) -> None:
        self._files: dict[str, Path] = {}
        for prefix, folder in folders.items():
            for path in sorted(folder.rglob("*")):
                if path.suffix in _TYPES:
                    self._files[f"{prefix}/{path.relative_to(folder).as_posix()}"] = path

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Answer with a file."""
        path = self._files.get(request.path)
        if path is None:
            raise web.HTTPNotFound
        headers = {"Cache-Control": "no-cache"}
        return web.Response(body=path.read_bytes(), content_type=_TYPES[path.suffix], charset="utf-8", headers=headers)


def make_app(
    guard: Guard, broadcast: Broadcast, drive: Drive, scene: Callable[[], Awaitable[bytes]]
) -> web.Application:
    """The application.

    Args:
        guard: admits requests.
        broadcast: streams to pages.
        drive: handles commands and emergency stops of pages.
        scene: returns the robot's shapes, as `ibrobot_web.scene` makes them.
    """
    app = web.Application(middlewares=[guard.middleware], client_max_size=LARGEST_MESSAGE)
    app.on_response_prepare.append(guard.add_headers)
    files = Files({"/static": STATIC})

    async def index(request: web.Request) -> web.StreamResponse:
        return web.Response(text=(STATIC / "index.html").read_text(encoding="utf-8"), content_type="text/html")

    async def session(request: web.Request) -> web.StreamResponse:
        links = {"watch": guard.path("watch")} if guard.session(request).role == "drive" else {}
        return web.json_response({"role": guard.session(request).role, "links": links})

    async def shapes(request: web.Request) -> web.StreamResponse:
        return web.Response(body=await scene(), content_type="application/json")

    async def stream(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await broadcast.serve(socket)
        return socket

    async def commands(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await drive.serve(socket, guard.session(request).role, request.remote or "?")
        return socket

    async def stop_line(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await drive.serve_stop(socket, guard.session(request).role)
        return socket

    async def stop(request: web.Request) -> web.StreamResponse:
        reply = await drive.stop_now(guard.session(request).role)
        return web.json_response(dict(reply), status=400 if "error" in reply else 200)

    app.router.add_get("/", index)
    app.router.add_get("/api/session", session)
    app.router.add_get("/api/scene", shapes)
    app.router.add_get("/stream", stream)
    app.router.add_get("/drive", commands)
    app.router.add_get("/stop", stop_line)
    app.router.add_post("/api/stop", stop)
    app.router.add_get("/static/{path:.*}", files.serve)
    return app


async def _socket(request: web.Request) -> web.WebSocketResponse:
    socket = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=LARGEST_MESSAGE, compress=False)
    await socket.prepare(request)
    return socket
