"""The files of a page."""

from __future__ import annotations

from pathlib import Path

from aiohttp import web

STYLE = "/static/style.css"
"""The one file that is served without a session, for the pages that ask for one."""
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}


def add_files(app: web.Application, folder: Path, page: str = "index.html") -> None:
    """Serve the files of a folder below `/static/`, and one of them as the page at `/`.

    The files are listed now: no path of a request reaches the file system.
    """
    files = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if path.suffix in _TYPES}

    async def index(request: web.Request) -> web.StreamResponse:
        return _answer(folder / page)

    async def file(request: web.Request) -> web.StreamResponse:
        path = files.get(request.match_info["path"])
        if path is None:
            raise web.HTTPNotFound
        return _answer(path)

    app.router.add_get("/", index, allow_head=False)
    app.router.add_get("/static/{path:.*}", file, allow_head=False)


def _answer(path: Path) -> web.StreamResponse:
    headers = {"Cache-Control": "no-cache"}
    return web.Response(body=path.read_bytes(), content_type=_TYPES[path.suffix], charset="utf-8", headers=headers)
