"""Reports of plugins on the page of `ibrobot ui`, with a kind that no plugin has."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from ibrobot_provenance.reports import (
    PLOT_CLASSES,
    Case,
    Cases,
    Fix,
    Plots,
    ReportDescriptor,
    ReportSection,
    Table,
    Text,
)
from ibrobot_web.ui import recordings, reports
from ui_server import UiServer, run_ui

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Registry

STATIC = Path(reports.__file__).parents[1] / "static"
FILE = "tasting.txt"


def taste(folder: Path) -> list[ReportSection]:
    if "spilt" in (folder / FILE).read_text():
        raise IbrobotError(f"{folder / FILE}: is spilt")
    cases = [
        Case(
            "cup 1",
            "cold",
            folder / "one",
            folder / "one.mp4",
            "brew --cup 1",
            1.5,
            (Fix("Drop", "delete"),),
            folder / "cup.png",
        ),
        Case("cup 2", "gone", folder / "two", folder / "link.mp4"),
        Case("cup 3", "never filled", folder / "set:2"),
    ]
    table = Table(("cup", "taste"), (("1", "nut"),))
    return [ReportSection("Tasting", (Text("fine", "verdict"), table, Plots(("<svg/>",)), Cases(tuple(cases))))]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    descriptor = ReportDescriptor(
        "tasting",
        summary="what was tasted",
        label="Tastings",
        reads=lambda path: (path / FILE).is_file(),
        lines=lambda path: [taste(path)[0].title],
        make=taste,
    )
    for module in (recordings, reports):
        monkeypatch.setattr(module, "kinds_of_reports", lambda: {"tasting": descriptor})
    monkeypatch.setattr(recordings, "installed_plugins", Registry)
    opened = tmp_path / "opened"
    for name in ("good", "bad"):
        (opened / name).mkdir(parents=True)
        (opened / name / FILE).write_text("spilt" if name == "bad" else "fine")
    (opened / "good/one").mkdir()
    (opened / "good/set").mkdir()
    (opened / "good/one.mp4").write_bytes(bytes(range(100)))
    (opened / "good/cup.png").write_bytes(b"cup")
    (tmp_path / "secret.mp4").write_bytes(b"secret")
    (opened / "good/link.mp4").symlink_to(tmp_path / "secret.mp4")
    return opened


def test_reports_are_listed_and_shown(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        rows = {each["path"]: each for each in await server.get("reports/list", kind="tasting")}
        assert (rows["good"]["lines"], rows["good"]["problem"]) == (["Tasting"], "")
        assert (rows["bad"]["lines"], rows["bad"]["problem"]) == ([], "bad/tasting.txt: is spilt")
        (section,) = await server.get("reports/show", kind="tasting", path="good")
        text, table, plots, cases = section["blocks"]
        assert text == {"kind": "text", "text": "fine", "role": "verdict"}
        assert (table["columns"], table["rows"], plots["pictures"]) == (["cup", "taste"], [["1", "nut"]], ["<svg/>"])
        assert cases["cases"] == [
            {
                "title": "cup 1",
                "text": "cold",
                "command": "brew --cup 1",
                "episode": "good/one",
                "video": "good/one.mp4",
                "picture": "good/cup.png",
                "at_s": 1.5,
                "fixes": [{"label": "Drop", "does": "delete", "outcome": "", "begin_s": 0.0, "end_s": 0.0}],
            },
            {
                "title": "cup 2",
                "text": "gone",
                "command": "",
                "episode": "",
                "video": "",
                "picture": "",
                "at_s": 0.0,
                "fixes": [],
            },
            {
                "title": "cup 3",
                "text": "never filled",
                "command": "",
                "episode": "good/set:2",
                "video": "",
                "picture": "",
                "at_s": 0.0,
                "fixes": [],
            },
        ]

    run_ui([folder], test)


def test_wrong_requests_for_reports_are_errors(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        wrong: tuple[tuple[str, dict[str, Any], str], ...] = (
            ("list", {"kind": "../x"}, "'../x' is no kind of report; installed: tasting"),
            ("show", {"kind": "tasting", "path": "bad"}, "^bad/tasting.txt: is spilt"),
            ("show", {"kind": "tasting", "path": "good/one"}, "good/one: is not among the tastings"),
            ("show", {"kind": "tasting", "path": "../"}, "outside the opened folders"),
            ("video", {"path": "good/link.mp4"}, "outside the opened folders"),
            ("video", {"path": "../secret.mp4"}, "outside the opened folders"),
            ("video", {"path": f"good/{FILE}"}, "there is no such video"),
            ("video", {"path": "good/three.mp4"}, "there is no such video"),
            ("picture", {"path": "good/one.mp4"}, "there is no such picture"),
            ("picture", {"path": "good/none.png"}, "there is no such picture"),
            ("picture", {"path": "../secret.png"}, "outside the opened folders"),
        )
        for request, query, error in wrong:
            with pytest.raises(RuntimeError, match=error):
                await server.get(f"reports/{request}", **query)

    run_ui([folder], test)


def test_browsers_may_ask_for_parts_of_a_video(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        path = "/api/reports/video?path=good/one.mp4"
        async with server.client.get(path, headers={"Range": "bytes=10-19"}) as answer:
            assert (answer.status, answer.content_type, await answer.read()) == (206, "video/mp4", bytes(range(10, 20)))
            assert answer.headers["Cache-Control"] == "no-store"

    run_ui([folder], test)


def test_page_colours_all_classes_of_plots() -> None:
    style = (STATIC / "ui/recordings.css").read_text(encoding="utf-8")
    assert set(re.findall(r"\.plotted \.([\w-]+) \{", style)) == set(PLOT_CLASSES)
    for stroke in ("range", "estimate", "margin", "bad"):  # the page takes shapes without their attribute `fill`
        assert re.search(rf"\.plotted \.{stroke} \{{[^}}]*fill: none;", style), stroke


def test_a_picture_of_a_report_is_served(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        async with server.client.get("/api/reports/picture?path=good/cup.png") as answer:
            assert (answer.status, answer.content_type, await answer.read()) == (200, "image/png", b"cup")
            assert answer.headers["Cache-Control"] == "no-store"

    run_ui([folder], test)
