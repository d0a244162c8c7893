"""Views: reports of plugins on folders with results, e.g. evaluations; their recordings are played back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.reports import (
    Case,
    Cases,
    Plots,
    ReportDescriptor,
    ReportSection,
    Table,
    Text,
    kinds_of_reports,
)

from ibrobot_core.api import IbrobotError
from ibrobot_web.ui.context import File, Routes, Ui
from ibrobot_web.ui.recordings import find_recordings

_VIDEO = ".mp4"
_PICTURES = {".png": "image/png", ".jpg": "image/jpeg"}


def _kind(name: str) -> ReportDescriptor:
    known = kinds_of_reports()
    if name not in known:
        raise IbrobotError(f"{name[:40]!r} is no kind of report; installed: {', '.join(known) or 'none'}")
    return known[name]


def listing(ui: Ui, kind: str) -> list[dict[str, Any]]:
    """The folders of a kind in the opened folders, the newest first."""
    descriptor = _kind(kind)
    reports = find_recordings(ui.folders).reports.get(descriptor.type, ())
    rows = []
    for folder in reports:
        try:
            lines, problem = list(descriptor.lines(folder)), ""
        except IbrobotError as error:
            lines, problem = [], str(error).replace(f"{ui.folders.first}/", "")
        path, changed_s = ui.folders.name(folder), folder.stat().st_mtime
        rows.append({"path": path, "lines": lines, "problem": problem, "changed_s": changed_s})
    return sorted(rows, key=lambda row: row["changed_s"], reverse=True)


def show(ui: Ui, path: str, kind: str) -> list[dict[str, Any]]:
    """A report."""
    folder = ui.folders.find(path)
    descriptor = _kind(kind)
    if not descriptor.reads(folder):
        raise IbrobotError(f"{ui.folders.name(folder)}: is not among the {descriptor.label.lower()}")
    try:
        return [_section(ui, each) for each in descriptor.make(folder)]
    except IbrobotError as error:
        raise IbrobotError(str(error).replace(f"{ui.folders.first}/", "")) from error


def _section(ui: Ui, section: ReportSection) -> dict[str, Any]:
    return {"title": section.title, "blocks": [_block(ui, each) for each in section.blocks]}


def _block(ui: Ui, block: Text | Table | Plots | Cases) -> dict[str, Any]:
    match block:
        case Text() | Table() | Plots():
            return {"kind": type(block).__name__.lower(), **attrs.asdict(block)}
        case Cases(cases):
            return {"kind": "cases", "cases": [_case(ui, each) for each in cases]}


def _case(ui: Ui, case: Case) -> dict[str, Any]:
    return {
        "title": case.title, "text": case.text, "command": case.command, "episode": _name(ui, case.episode),
        "video": _name(ui, case.video), "picture": _name(ui, case.picture), "at_s": case.at_s,
        "fixes": [attrs.asdict(each) for each in case.fixes],
    }  # fmt: skip


def _name(ui: Ui, path: Path | None) -> str:
    """A path for requests, also `DATASET:N`; empty if it is outside the opened folders, or there is nothing."""
    if path is None or not (path.exists() or path.with_name(path.name.rpartition(":")[0] or path.name).exists()):
        return ""
    try:
        return ui.folders.name(ui.folders.find(str(path)))
    except IbrobotError:
        return ""


def video(ui: Ui, path: str) -> File:
    """A video."""
    file = ui.folders.find(path)
    if file.suffix != _VIDEO or not file.is_file():
        raise IbrobotError(f"{ui.folders.name(file)}: there is no such video")
    return File(file, "video/mp4")


def picture(ui: Ui, path: str) -> File:
    """A picture."""
    file = ui.folders.find(path)
    if file.suffix not in _PICTURES or not file.is_file():
        raise IbrobotError(f"{ui.folders.name(file)}: there is no such picture")
    return File(file, _PICTURES[file.suffix])


ROUTES: Routes = {
    "GET /list": listing,
    "GET /show": show,
    "GET /video": video,
    "GET /picture": picture,
}
