"""`ibrobot ui` with the application in this process: its frame, folders and jobs."""

from __future__ import annotations

import asyncio
import io
import os
import sys
from collections.abc import Awaitable, Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from ibrobot_provenance.reports import ReportDescriptor
from ibrobot_web.ui.forms import takes
from ibrobot_web.ui.server import views
from ui_server import UiServer, run_ui

PYTHON = (sys.executable, "-c")


def run(folder: Path, test: Callable[[UiServer], Awaitable[None]]) -> None:
    run_ui([folder], test)


def test_every_view_has_its_module_for_browsers(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        page = await server.text("/")
        assert "/static/ui.js" in page
        session = await server.get("session")
        assert (session["role"], session["folders"]) == ("drive", [str(tmp_path)])
        for view in session["views"]:
            assert "export class View" in await server.text(f"/static/ui/{view['module']}.js")

    run(tmp_path, test)


with_all = pytest.mark.skipif(
    not all(map(find_spec, ("ibrobot_data", "ibrobot_diagnose", "ibrobot_eval", "ibrobot_lerobot", "ibrobot_mujoco"))),
    reason="needs all packages with commands of the page: uv sync",
)


@pytest.mark.integration
@with_all
def test_views_stand_in_groups_in_the_order_of_the_work() -> None:
    groups: dict[str, list[str]] = {}
    for view in views():
        if not view.get("within"):
            groups.setdefault(view["group"], []).append(view["name"])
    assert list(groups) == ["Set up", "Record", "Learn", "Evaluate", ""]
    jobs = ("convert", "train", "datasets check")
    learn = [f"job-{name}" for name in jobs if takes(name)]  # installed ones
    assert [name for name in groups["Learn"] if name not in learn] == ["datasets", "policies"]
    assert set(learn) <= set(groups["Learn"])
    assert "job-eval" in groups["Evaluate"]
    # By what a person wants with them.
    for name, group in (("explain", "Evaluate"), ("identify", "Set up"), ("preflight", "Set up")):
        found = [each for each, members in groups.items() if f"job-{name}" in members]
        assert found == ([group] if takes(name) else [])


@pytest.mark.integration
@with_all
@pytest.mark.parametrize(
    ("command", "within", "group"),
    [("convert", "job-convert", "Learn"), ("", "", "Evaluate"), ("brew", "", "Evaluate")],
)
def test_reports_are_reached_from_the_command_that_writes_them(
    monkeypatch: pytest.MonkeyPatch, command: str, within: str, group: str
) -> None:
    made = ReportDescriptor(
        "made", summary="", label="Made", command=command, reads=bool, lines=lambda _: [], make=lambda _: []
    )
    monkeypatch.setattr("ibrobot_web.ui.server.kinds_of_reports", lambda: {"made": made})
    (view,) = [each for each in views() if each["name"] == "report-made"]
    assert (view["within"], view["group"]) == (within, group)


def test_nothing_is_served_without_a_session_and_watching_changes_nothing(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        async with server.browser() as stranger:
            for path in ("/", "/api/session", "/api/jobs", "/api/jobs/cancel", "/static/ui.js"):
                async with stranger.get(path) as answer:
                    assert answer.status == 401, path
            await server.sign_in(stranger, "watch")
            async with stranger.post("/api/jobs/cancel", json={"number": 1}) as answer:
                assert (answer.status, await answer.json()) == (400, {"error": "this link is for watching only"})
            for headers in ({"Origin": "http://evil.example"}, {"Sec-Fetch-Site": "same-site"}):
                async with stranger.post("/api/jobs/cancel", json={"number": 1}, headers=headers) as answer:
                    assert answer.status == 403

    run(tmp_path, test)


@pytest.mark.parametrize(
    ("body", "error"),
    [
        (b"[]", "must be a JSON object"),
        (b"{", "must be JSON"),
        (b"[" * 100_000, "must be JSON"),
        (b"{}", "number: required key is missing"),
        (b'{"number": "1"}', "number: expected a whole number"),
    ],
    ids=lambda value: str(value)[:12],
)
def test_malformed_requests_are_refused(tmp_path: Path, body: bytes, error: str) -> None:
    async def test(server: UiServer) -> None:
        async with server.client.post(
            "/api/jobs/cancel", data=body, headers={"Content-Type": "application/json"}
        ) as answer:
            assert answer.status == 400
            assert error in (await answer.json())["error"]
        async with server.client.post("/api/jobs/cancel", data=io.BytesIO(bytes(2 << 20))) as answer:
            assert answer.status in (400, 413)

    run(tmp_path, test)


def test_paths_are_confined_to_the_opened_folders(tmp_path: Path) -> None:
    from ibrobot_web.ui.folders import Folders

    from ibrobot_core.api import IbrobotError

    inside, other = tmp_path / "inside", tmp_path / "other"
    inside.mkdir()
    other.mkdir()
    (inside / "link").symlink_to("/etc")
    folders = Folders([inside, other])
    assert folders.find("a/../b.yaml") == inside / "b.yaml"
    assert folders.find(folders.name(other / "c")) == other / "c"
    for text in ("..", "../x", "/etc/passwd", "link/passwd", str(tmp_path), "a\0b"):
        with pytest.raises(IbrobotError):
            folders.find(text)


def test_a_job_streams_its_output_its_progress_and_its_end(tmp_path: Path) -> None:
    def read(line: str) -> dict[str, Any] | None:
        return {"progress": float(line[4:])} if line.startswith("at: ") else None

    async def test(server: UiServer) -> None:
        code = "print('at: 0.5'); print('\\x1b[31mred\\r50%\\r'); print('error: no disk'); raise SystemExit(2)"
        server.ui.jobs.start("convert", "Convert", [code], program=PYTHON, read=read)
        job, lines = await server.job(lambda job: job["state"] == "failed")
        assert (job["exit_code"], job["facts"], job["title"]) == (2, {"progress": 0.5}, "Convert")
        assert lines == ["at: 0.5", "red", "50%", "error: no disk"]

    run(tmp_path, test)


def test_a_job_ends_with_its_process_even_if_another_one_keeps_its_output_open(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "end")

    async def test(server: UiServer) -> None:
        child = "import subprocess; print('started', flush=True); subprocess.Popen(['sh', '-c', 'read line < end'])"
        server.ui.jobs.start("run", "Run", [child], program=PYTHON)
        job, lines = await server.job(lambda job: job["state"] != "running")
        assert (job["state"], lines) == ("done", ["started"])

    try:
        run(tmp_path, test)
    finally:
        (tmp_path / "end").write_text("\n")  # the other one ends


def test_a_job_is_cancelled_as_by_ctrl_c_and_then_at_once(tmp_path: Path) -> None:
    stubborn = (
        "import signal, time\nsignal.signal(signal.SIGINT, lambda *_: print('not yet', flush=True))\n"
        "print('ready', flush=True)\nwhile True: time.sleep(1)"
    )

    async def test(server: UiServer) -> None:
        number = server.ui.jobs.start("run", "Run", [stubborn], program=PYTHON).number
        await server.job(lambda job: True, "ready")
        await server.post("jobs/cancel", number=number)
        await server.job(lambda job: job["cancelling"], "not yet")
        await server.post("jobs/cancel", number=number)
        job, _ = await server.job(lambda job: job["state"] == "cancelled")
        assert job["exit_code"] == -9

    run(tmp_path, test)


def test_jobs_end_with_the_server(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        server.ui.jobs.start("run", "Run", ["import time\nprint('ready', flush=True)\ntime.sleep(100)"], program=PYTHON)
        await server.job(lambda job: True, "ready")
        await asyncio.to_thread(server.ui.jobs.close)
        assert [job.state for job in server.ui.jobs.all()] == ["cancelled"]
        with pytest.raises(Exception, match="is ending"):
            server.ui.jobs.start("run", "Run", [], program=PYTHON)

    run(tmp_path, test)


def test_a_program_that_is_not_installed_is_named(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        with pytest.raises(Exception, match="no-such-program cannot be started: No such file"):
            server.ui.jobs.start("train", "Train", [], program=("no-such-program",))

    run(tmp_path, test)


def test_a_link_from_this_page_to_the_page_of_a_run_is_followed(tmp_path: Path) -> None:
    """Both are on this machine, with different ports, which browsers call the same site."""
    click = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}

    async def test(server: UiServer) -> None:
        async with server.browser() as browser:
            async with browser.get(server.guard.path("drive"), headers=click) as answer:
                assert answer.status == 200
            async with browser.get("/api/session", headers=click) as answer:
                assert answer.status == 403
            async with browser.get("/", headers={**click, "Sec-Fetch-Dest": "iframe"}) as answer:
                assert answer.status == 403
            async with browser.get("/", headers={**click, "Sec-Fetch-Site": "cross-site"}) as answer:
                assert answer.status == 403

    run(tmp_path, test)


def test_the_stream_of_jobs_needs_this_page(tmp_path: Path) -> None:
    async def test(server: UiServer) -> None:
        with pytest.raises(aiohttp.WSServerHandshakeError):
            await server.client.ws_connect("/api/jobs", headers={"Origin": "http://127.0.0.1:1"})

    run(tmp_path, test)
