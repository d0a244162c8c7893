"""The web application of `ibrobot ui`: its page, the views' requests, and the stream of jobs."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import logging
from collections.abc import Mapping
from importlib import import_module
from typing import Any

import attrs
from aiohttp import WSMsgType, web
from ibrobot_http.files import add_files
from ibrobot_http.guard import Guard
from ibrobot_provenance.reports import kinds_of_reports

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import ConfigError, error_text
from ibrobot_web.pictures import Picture
from ibrobot_web.server.app import STATIC
from ibrobot_web.ui.context import File, Handler, Routes, Ui, read_facts, read_query
from ibrobot_web.ui.forms import job_commands, takes, title_of

GROUPS = {
    "Set up": ("robots", "devices"), "Record": ("record", "episodes"), "Learn": ("datasets", "policies"),
    "Evaluate": (), "": ("jobs",),
}  # fmt: skip
"""Group of views, in the order of the work -> views. The module `ibrobot_web.ui.NAME` has the `ROUTES` of one, and
`static/ui/NAME.js` shows it. Each command that runs as a job has a view, too, all by `static/ui/command.js`; each kind
of report has one, all by `static/ui/reports.js`."""
SHOWN = {"episodes": "datasets", "dataset": "policies"}
"""Kind of a command's input -> the view before which its own stands; others are in the last group."""
PLACED = {"explain": "Evaluate", "identify": "Set up", "preflight": "Set up"}
"""Command -> the group at whose end it stands, where its input would put it into another one."""
ROUTED = (*(name for names in GROUPS.values() for name in names), "reports")
"""The modules with `ROUTES`."""
LARGEST_REQUEST = 1 << 20
"""Largest body of a request [bytes]."""
_HEARTBEAT_S = 5.0
_JOBS_S = 0.1
"""Shortest time between two messages about jobs [s]."""
_UI: web.AppKey[Ui] = web.AppKey("ui", Ui)
_log = logging.getLogger("ibrobot.ui")


def make_app(guard: Guard, ui: Ui) -> web.Application:
    """The application.

    Args:
        guard: has the roles of sessions.
        ui: the folders, jobs and state that requests share.
    """
    app = web.Application(middlewares=[_errors], client_max_size=LARGEST_REQUEST)
    app[_UI] = ui
    add_files(app, STATIC, "ui.html")

    async def session(request: web.Request) -> web.StreamResponse:
        folders = [str(path) for path in ui.folders.paths]
        return web.json_response({"role": guard.role(request), "folders": folders, "views": views()})

    async def follow(request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=LARGEST_REQUEST, compress=False)
        await socket.prepare(request)
        await _send_jobs(socket, ui, drives=guard.role(request) == "drive")
        return socket

    app.router.add_get("/api/session", session)
    app.router.add_get("/api/jobs", follow)
    for name in ROUTED:
        for route, handler in routes_of(name).items():
            method, path = route.split()
            app.router.add_route(method, f"/api/{name}{path}", functools.partial(_answer, handler, guard))
    return app


def views() -> list[dict[str, Any]]:
    """The views for browsers, in the order of the work. One that stands `within` another is reached from that one."""
    made: list[dict[str, Any]] = [
        {"name": name, "title": name.capitalize(), "module": name, "group": group}
        for group, names in GROUPS.items()
        for name in names
    ]
    last = list(GROUPS)[-2]
    for command in job_commands():
        job = {
            "name": f"job-{command}", "title": title_of(command), "module": "command", "command": command,
            "takes": takes(command),
        }  # fmt: skip
        before = next((SHOWN[kind] for kind in job["takes"] if kind in SHOWN), "")
        at = next((i for i, view in enumerate(made) if view["name"] == before), len(made) - 1)
        group = made[at]["group"] or last
        if command in PLACED:
            group = PLACED[command]
            at = max((i + 1 for i, view in enumerate(made) if view["group"] == group), default=len(made) - 1)
        made.insert(at, {**job, "group": group})
    groups = {view["name"]: view["group"] for view in made}
    for kind, each in kinds_of_reports().items():
        within = f"job-{each.command}"
        made.insert(-1, {
            "name": f"report-{kind}", "title": each.label, "module": "reports", "report": kind,
            "group": groups.get(within, last), "within": within if within in groups else "",
        })  # fmt: skip
    return made


def routes_of(view: str) -> Routes:
    """The requests of a view, e.g. `GET /list`, and how each is answered."""
    routes: Routes = import_module(f"ibrobot_web.ui.{view}").ROUTES
    return routes


async def _answer(handler: Handler, guard: Guard, request: web.Request) -> web.StreamResponse:
    """Answer a view's request, in a thread. Sessions for watching may only GET, which changes nothing."""
    if request.method == "GET":
        facts = read_query(handler, request.query)
    else:
        if guard.role(request) != "drive":
            raise IbrobotError("this link is for watching only")
        facts = read_facts(handler, await _body(request))
    answer = await asyncio.to_thread(handler, request.app[_UI], **facts)
    if isinstance(answer, Picture):
        return web.Response(body=answer.content, content_type=answer.content_type)
    if isinstance(answer, File):
        return web.FileResponse(answer.path, headers={"Content-Type": answer.content_type})
    return web.json_response(answer, dumps=_dumps)


async def _body(request: web.Request) -> Mapping[str, Any]:
    if request.content_type != "application/json":
        raise IbrobotError("a request must be JSON")
    try:
        body = json.loads(await request.read())
    except (ValueError, RecursionError):
        raise IbrobotError("a request must be JSON") from None
    if not isinstance(body, dict):
        raise IbrobotError("a request must be a JSON object")
    return body


def _dumps(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


@web.middleware
async def _errors(request: web.Request, handler: Any) -> web.StreamResponse:
    """Answer with the errors that a page shows."""
    try:
        response: web.StreamResponse = await handler(request)
    except ConfigError as error:
        problems = [{**attrs.asdict(each), "file": str(each.file)} for each in error.problems]
        return web.json_response({"error": str(error), "problems": problems}, status=400)
    except IbrobotError as error:
        return web.json_response({"error": str(error)}, status=400)
    except web.HTTPException:
        raise
    except Exception as error:  # noqa: BLE001 - contained: a request must not end the server
        _log.exception("%s %s failed", request.method, request.path)
        return web.json_response({"error": error_text(error)}, status=500)
    return response


async def _send_jobs(socket: web.WebSocketResponse, ui: Ui, *, drives: bool) -> None:
    """Send all jobs, and then each change, until the page is gone."""
    loop = asyncio.get_running_loop()
    changed = asyncio.Event()

    def notify() -> None:
        with contextlib.suppress(RuntimeError):  # the server has ended
            loop.call_soon_threadsafe(changed.set)

    ui.jobs.listeners.add(notify)
    sending = asyncio.create_task(_send_changes(socket, ui, changed, drives=drives))
    try:
        async for message in socket:
            if message.type is WSMsgType.ERROR:
                break
    finally:
        ui.jobs.listeners.discard(notify)
        sending.cancel()
        await asyncio.gather(sending, return_exceptions=True)


async def _send_changes(socket: web.WebSocketResponse, ui: Ui, changed: asyncio.Event, *, drives: bool) -> None:
    sent: dict[int, tuple[int, int]] = {}
    """Number of a job -> its version and its number of lines, as sent."""
    while True:
        changed.clear()
        for job in ui.jobs.all():
            version, count = sent.get(job.number, (-1, 0))
            if job.version != version:
                version = job.version
                total, lines = ui.jobs.lines_after(job, count)
                await socket.send_str(_dumps({"job": job.json(drives=drives), "lines": lines}))
                sent[job.number] = (version, total)
        await changed.wait()
        await asyncio.sleep(_JOBS_S)
