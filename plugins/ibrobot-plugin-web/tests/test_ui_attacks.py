"""Attacks on the requests of all views of `ibrobot ui`: strangers, other sites, watchers, large bodies, wrong facts."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from ibrobot_web.ui.server import LARGEST_REQUEST, VIEWS, routes_of
from ui_server import UiServer, run_ui

FOREIGN = (
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Host": "evil.example"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
)
FILES = ("episodes", "convert", "datasets", "training")
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


def routes(views: Any = VIEWS) -> Iterator[tuple[str, str]]:
    for view in views:
        for route in routes_of(view):
            method, path = route.split()
            yield method, f"/api/{view}{path}"


async def status(browser: aiohttp.ClientSession, method: str, path: str, **more: Any) -> int:
    if method == "POST":
        more.setdefault("json", {})
    async with browser.request(method, path, **more) as answer:
        return answer.status


def test_strangers_watchers_and_other_sites_reach_no_request(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        async with server.browser() as stranger, server.browser() as watcher:
            await server.sign_in(watcher, "watch")
            for method, path in routes():
                assert await status(stranger, method, path) == 401, path
                for headers in FOREIGN:
                    assert await status(server.client, method, path, headers=headers) == 403, (path, headers)
                if method == "POST":
                    async with watcher.post(path, json={}) as answer:
                        assert (answer.status, await answer.json()) == (
                            400,
                            {"error": "this link is for watching only"},
                        )
                    assert await status(server.client, "GET", path) in (404, 405), "no link can change anything"
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


def test_a_hundred_megabytes_are_refused_without_reading_them(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        for size in (None, 100 << 20):  # in chunks, and with their length beforehand
            sent = 0

            async def body() -> AsyncIterator[bytes]:
                nonlocal sent
                for _ in range(100):
                    yield bytes(1 << 20)
                    sent += 1

            headers = {"Content-Type": "application/json"} | ({} if size is None else {"Content-Length": str(size)})
            with contextlib.suppress(aiohttp.ClientConnectionError):
                assert (
                    await status(server.client, "POST", "/api/convert/start", data=body(), headers=headers, json=None)
                    == 413
                )
            assert sent < 30
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
        facts = dict.fromkeys(("path", "out", "dataset", "robot", "checkpoint", "target"), outside)
        for method, path in routes(FILES):
            if path.endswith("/list"):
                continue
            if method == "GET":
                query = {**facts, "topic": "/t", "at_s": "0"}
                async with server.client.get(path, params=query) as answer:
                    text = json.dumps(await answer.json())
            else:
                more = {"paths": [outside], "begin_s": 0, "end_s": 1, "id": "x", "outcome": "success", "digest": "x"}
                async with server.client.post(path, json={**facts, **more, "steps": 1, "batch_size": 1}) as answer:
                    text = json.dumps(await answer.json())
            assert "outside the opened folders" in text or "a plugin that is not installed" in text, (path, text)
        assert server.ui.jobs.all() == []

    run_ui([folder], test)
    assert list(folder.iterdir()) == []
