"""The web application: pages, their files, the stream of states and pictures, and the commands."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

from aiohttp import web
from ibrobot_http.files import add_files
from ibrobot_http.guard import Guard

from ibrobot_web.messages import LARGEST_MESSAGE
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Drive

STATIC = Path(__file__).parents[1] / "static"
_HEARTBEAT_S = 5.0
"""Period of pings, which detect pages that vanished without closing their connection [s]."""


def make_app(
    guard: Guard, broadcast: Broadcast, drive: Drive, scene: Callable[[], Awaitable[bytes]]
) -> web.Application:
    """The application.

    Args:
        guard: has the roles of sessions.
        broadcast: streams to pages.
        drive: handles commands and emergency stops of pages.
        scene: returns the robot's shapes, as `ibrobot_web.scene` makes them.
    """
    app = web.Application(client_max_size=LARGEST_MESSAGE)
    add_files(app, STATIC)

    async def session(request: web.Request) -> web.StreamResponse:
        role = guard.role(request)
        return web.json_response({"role": role, "links": {"watch": guard.path("watch")} if role == "drive" else {}})

    async def shapes(request: web.Request) -> web.StreamResponse:
        return web.Response(body=await scene(), content_type="application/json")

    async def stream(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await broadcast.serve(socket)
        return socket

    async def commands(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await drive.serve(socket, guard.role(request), request.remote or "?")
        return socket

    async def stop_line(request: web.Request) -> web.StreamResponse:
        socket = await _socket(request)
        await drive.serve_stop(socket, guard.role(request))
        return socket

    async def stop(request: web.Request) -> web.StreamResponse:
        reply = await drive.stop_now(guard.role(request))
        return web.json_response(dict(reply), status=400 if "error" in reply else 200)

    app.router.add_get("/api/session", session)
    app.router.add_get("/api/scene", shapes)
    app.router.add_get("/stream", stream)
    app.router.add_get("/drive", commands)
    app.router.add_get("/stop", stop_line)
    app.router.add_post("/api/stop", stop)
    return app


async def _socket(request: web.Request) -> web.WebSocketResponse:
    socket = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=LARGEST_MESSAGE, compress=False)
    await socket.prepare(request)
    return socket
