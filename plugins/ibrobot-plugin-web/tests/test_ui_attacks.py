"""Attacks on the requests of all views of `ibrobot ui`: strangers, other sites, watchers, large bodies, wrong facts."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import logging
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import attrs
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
FILES = ("episodes", "datasets", "policies")
"""Views whose requests name files."""
WRONG: tuple[Any, ...] = (
    {},
    {"path": 3, "paths": 3, "out": 3, "dataset": 3},
    {"path": None, "paths": [None]},
    {"path": {"a": []}},
    {"path": "a\0b", "paths": ["a\0b"], "out": "a\0b", "dataset": "\0", "robot": "\0", "checkpoint": "\0"},
    {"path": "a" * 100_000, "paths": ["a" * 100_000], "out": "b" * 5000, "dataset": "c" * 5000},
)
ENDED_S = 8.0
"""The time in which requests that are sent by half are ended by far, here after 0.2 s."""
OUTSIDE = ("..", "../x", "/etc/passwd", "/", "a/../../b", "//etc")


def routes(views: Any = VIEWS) -> Iterator[tuple[str, str]]:
    for view in views:
        for route in routes_of(view):
            method, path = route.split()
            yield method, f"/api/{view}{path}"


def keys_of(method: str, path: str) -> set[str]:
    """The keys of a request."""
    _, _, view, name = path.split("/")
    return {field.name for field in attrs.fields(routes_of(view)[f"{method} /{name}"].request)}


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


def test_unknown_keys_are_refused_before_anything_runs(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        for method, path in routes():
            sent: dict[str, Any] = {"params": {"--help": "1"}} if method == "GET" else {"json": {"--help": 1}}
            async with server.client.request(method, path, **sent) as answer:
                assert (answer.status, "--help: unknown key" in (await answer.json())["error"]) == (400, True), path
        assert server.ui.jobs.all() == []

    run_ui([tmp_path], test)


def test_requests_that_are_sent_by_half_are_ended_and_what_is_no_http_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("ibrobot_http.guard.REQUEST_S", 0.2)
    garbage = (
        b"", b"GET / HTTP/1.1\r\nHost: x\r\n", b"G", b"\x16\x03\x01\x00\xa5", b"GET / HTTP/9.9\r\n\r\n",
        b"GET / HTTP/1.1\r\nContent-Length: x\r\n\r\n", b"POST / HTTP/1.1\r\nTransfer-Encoding: y\r\n\r\n",
        b"\x00" * 100, b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\n\r\n",
    )  # fmt: skip

    async def test(server: UiServer) -> None:
        async def send(data: bytes) -> None:
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            try:
                writer.write(data)
                with contextlib.suppress(ConnectionError):
                    await asyncio.wait_for(reader.read(), ENDED_S)
            except TimeoutError:
                raise AssertionError(f"the connection stays open after {data[:60]!r}") from None
            finally:
                writer.transport.abort()

        await asyncio.gather(*(send(data) for data in garbage * 5))
        cookies = server.client.cookie_jar.filter_cookies(server.client._base_url)  # type: ignore[arg-type]
        cookie = "; ".join(f"{each.key}={each.value}" for each in cookies.values())
        head = f"POST /api/jobs/cancel HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nCookie: {cookie}\r\n"
        await send(f"{head}Content-Type: application/json\r\nContent-Length: 20\r\n\r\n{{".encode())
        await server.get("session")

    run_ui([tmp_path], test)
    assert [record for record in caplog.records if record.exc_info or record.levelno >= logging.WARNING] == []


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
                    await status(server.client, "POST", "/api/jobs/start", data=body(), headers=headers, json=None)
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
        facts: dict[str, Any] = dict.fromkeys(("path", "out", "dataset", "robot", "checkpoint", "target"), outside)
        more = {"paths": [outside], "begin_s": 0, "end_s": 1, "id": "x", "outcome": "success", "digest": "x"}
        facts |= {**more, "steps": 1, "batch_size": 1, "topic": "/t", "at_s": 0}
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
