"""Attacks on the requests of all views of `ibrobot ui`: strangers, other sites, watchers, large bodies, wrong facts."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, override
from unittest.mock import patch

import aiohttp
import attrs
import pytest
from ibrobot_http.server import ServerThread
from ibrobot_provenance.processes import Jobs
from ibrobot_testing.http import HttpSuite, Served
from ibrobot_web.options import WebOptions
from ibrobot_web.server.page_guard import page_guard
from ibrobot_web.status import without_tokens
from ibrobot_web.ui.context import Ui, request_of
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.server import LARGEST_REQUEST, ROUTED, make_app, routes_of
from ui_server import UiServer, run_ui

FILES = ("episodes", "datasets", "policies", "reports")
"""Views whose requests name files."""
WRONG: tuple[Any, ...] = (
    {},
    {"path": 3, "paths": 3, "out": 3, "dataset": 3},
    {"path": None, "paths": [None]},
    {"path": {"a": []}},
    {"path": "a\0b", "paths": ["a\0b"], "out": "a\0b", "dataset": "\0", "robot": "\0", "checkpoint": "\0"},
    {"path": "a" * 100_000, "paths": ["a" * 100_000], "out": "b" * 5000, "dataset": "c" * 5000},
)
OUTSIDE = ("..", "../x", "/etc/passwd", "/", "a/../../b", "//etc")


def routes(views: Any = ROUTED) -> Iterator[tuple[str, str]]:
    for view in views:
        for route in routes_of(view):
            method, path = route.split()
            yield method, f"/api/{view}{path}"


def paths(method: str) -> tuple[str, ...]:
    """The paths of all views with a method."""
    return tuple(path for each, path in routes() if each == method)


def keys_of(method: str, path: str) -> set[str]:
    """The keys of a request."""
    _, _, view, name = path.split("/")
    return {field.name for field in attrs.fields(request_of(routes_of(view)[f"{method} /{name}"]))}


async def status(browser: aiohttp.ClientSession, method: str, path: str, **more: Any) -> int:
    if method == "POST":
        more.setdefault("json", {})
    async with browser.request(method, path, **more) as answer:
        return answer.status


class TestAttacks(HttpSuite):
    """What every server here withstands, on the requests of all views."""

    @override
    @contextlib.contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        with patch("ibrobot_http.guard.REQUEST_S", request_s), tempfile.TemporaryDirectory() as folder:
            guard = page_guard(WebOptions(port=0), any_port="0")
            opened = Folders([Path(folder)])
            with contextlib.closing(Ui(opened, Jobs(opened.first, without_tokens), ())) as ui:
                with contextlib.closing(ServerThread(guard, make_app(guard, ui), "ui", close_s=0.1)):
                    yield Served(
                        guard.listener.url,
                        ("/", "/static/ui.js", "/api/session", *paths("GET")),
                        paths("POST"),
                        ("/api/jobs",),
                        (guard.path("drive"), guard.path("watch")),
                    )
                assert ui.jobs.all() == []


def test_watchers_change_nothing(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        async with server.browser() as watcher:
            await server.sign_in(watcher, "watch")
            for path in paths("POST"):
                async with watcher.post(path, json={}) as answer:
                    assert (answer.status, await answer.json()) == (400, {"error": "this link is for watching only"})
                assert await status(server.client, "GET", path) in (404, 405), "no link can change anything"
        assert server.ui.jobs.all() == []

    run_ui([tmp_path], test)


def test_unknown_keys_are_refused_before_anything_runs(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        for method, path in routes():
            sent: dict[str, Any] = {"params": {"--help": "1"}} if method == "GET" else {"json": {"--help": 1}}
            async with server.client.request(method, path, **sent) as answer:
                assert (answer.status, "--help: unknown key" in (await answer.json())["error"]) == (400, True), path
        assert server.ui.jobs.all() == []

    run_ui([tmp_path], test)


def test_large_and_malformed_bodies_are_refused(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        for method, path in routes():
            if method != "POST":
                continue
            headers = {"Content-Type": "application/json"}
            large = io.BytesIO(bytes(LARGEST_REQUEST + 1))
            assert await status(server.client, method, path, data=large, headers=headers, json=None) == 413, path
            for body in (b"[]", b"{", b"\xff", b"[" * 5000, b"1e999", b""):
                assert await status(server.client, method, path, data=body, headers=headers, json=None) == 400, path
            form = aiohttp.FormData({"path": "x"})  # what a form of another site could send
            assert await status(server.client, method, path, data=form, json=None) == 400, path
        assert server.ui.jobs.all() == []

    run_ui([tmp_path], test)


def test_wrong_facts_are_errors_that_name_them(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        for method, path in routes(FILES):
            if method != "POST":
                continue
            for facts in WRONG:
                async with server.client.post(path, json=facts) as answer:
                    assert (answer.status, "error" in await answer.json()) == (400, True), (path, facts)
        assert server.ui.jobs.all() == []

    run_ui([tmp_path], test)


@pytest.mark.parametrize("outside", OUTSIDE)
def test_no_request_reaches_files_outside_the_opened_folders(tmp_path: Path, outside: str) -> None:
    folder = tmp_path / "opened"
    folder.mkdir()

    async def test(server: UiServer) -> None:
        facts: dict[str, Any] = dict.fromkeys(("path", "out", "dataset", "robot", "checkpoint", "target"), outside)
        more = {"paths": [outside], "begin_s": 0, "end_s": 1, "id": "x", "outcome": "success", "digest": "x"}
        facts |= {**more, "steps": 1, "batch_size": 1, "topic": "/t", "at_s": 0, "kind": "x"}
        for name in ("episodes", "out", "dataset", "config"):
            for command in ("convert", "train"):
                values: dict[str, Any] = (
                    {"episodes": ["."], "out": "new"} if command == "convert" else {"dataset": ".", "out": "new"}
                )
                values[name] = [outside] if name == "episodes" else outside
                with pytest.raises(RuntimeError, match=r"outside the opened folders|no field|not installed"):
                    await server.post("jobs/start", command=command, values=values)
        for method, path in routes(FILES):
            if path.endswith("/list"):
                continue
            known = {name: value for name, value in facts.items() if name in keys_of(method, path)}
            sent: dict[str, Any] = {"params": known} if method == "GET" else {"json": known}
            async with server.client.request(method, path, **sent) as answer:
                text = json.dumps(await answer.json())
            assert "outside the opened folders" in text or "a plugin that is not installed" in text, (path, text)
        assert server.ui.jobs.all() == []

    run_ui([folder], test)
    assert list(folder.iterdir()) == []
