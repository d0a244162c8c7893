"""Episodes, datasets, reports and policies in the opened folders."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.reports import kinds_of_reports

from ibrobot_core.api import NS_PER_S, IbrobotError, PolicyDescriptor
from ibrobot_core.app import installed_plugins
from ibrobot_web.playback import Playback, problems_of
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders

_DEPTH = 6
"""Levels of folders below an opened one in which recordings are looked for."""
_POLICY_DEPTH = 7
_MOST_FOLDERS = 20_000
_MOST_POLICIES = 200
"""Policies that are listed."""
_OPEN = 4
"""Episodes that stay open."""


@attrs.frozen
class Found:
    """What the folders contain."""

    episodes: tuple[Path, ...]
    datasets: tuple[Path, ...]
    trashes: tuple[Path, ...]
    """Folders that have a trash."""
    complete: bool
    """False if there are too many folders to search."""
    reports: Mapping[str, Sequence[Path]]
    """Kind of report -> the folders of that kind."""


def find_recordings(opened: Folders) -> Found:
    """The episodes, datasets and reports in the opened folders."""
    registry = installed_plugins()
    readers = registry.readers
    kinds = kinds_of_reports()
    reports: dict[str, dict[Path, None]] = {kind: {} for kind in kinds}
    episodes: list[Path] = []
    datasets: list[Path] = []
    trashes: list[Path] = []
    left = _MOST_FOLDERS
    for folder, folders, _ in opened.walk(_DEPTH):
        left -= 1
        for kind, each in kinds.items():
            if each.reads(folder):
                reports[kind][folder] = None
        if any(reader.reads(folder) for reader in readers if not reader.numbered):
            episodes.append(folder)
        elif any(reader.reads(folder) for reader in readers if reader.numbered):
            datasets.append(folder)
        elif left > 0:
            trashes += [folder] * (".trash" in folders)
            continue
        folders.clear()
    once = [tuple(dict.fromkeys(each)) for each in (episodes, datasets, trashes)]
    return Found(once[0], once[1], once[2], left > 0, {kind: tuple(of_kind) for kind, of_kind in reports.items()})


def policy_type(path: Path) -> str | None:
    """The type of the trained policy in a folder; None if there is none of an installed plugin."""
    registry = installed_plugins()
    for type_ in registry.types("policy"):
        descriptor = registry.find("policy", type_)
        if isinstance(descriptor, PolicyDescriptor) and descriptor.reads(path):
            return type_
    return None


def find_policies(ui: Ui) -> list[tuple[Path, str]]:
    """The folders with a trained policy in the opened folders, and the type of each; the newest first."""
    policies = []
    for parent, folders, _ in ui.folders.walk(_POLICY_DEPTH):
        if (type_ := policy_type(parent)) is not None:
            policies.append((parent, type_))
            folders.clear()
    return sorted(policies, key=lambda each: each[0].stat().st_mtime_ns, reverse=True)[:_MOST_POLICIES]


class Episodes:
    """Summaries of episodes, read once while their files stay the same, and the open ones. Thread-safe."""

    def __init__(self) -> None:
        self._summaries: dict[Path, tuple[Any, dict[str, Any]]] = {}
        self._open: dict[tuple[str, Any], Playback] = {}
        self._lock = threading.Lock()

    def row(self, ui: Ui, path: Path) -> dict[str, Any]:
        """An episode as a row of the list."""
        state = _state_of(path)
        with self._lock:
            known, row = self._summaries.get(path, (None, {}))
        if known != state:
            row = _row(ui, path)
            with self._lock:
                self._summaries[path] = (state, row)
        return row

    def opened(self, path: Path) -> Playback:
        """The open episode at a path, or `DATASET:N`.

        Raises:
            IbrobotError: if it cannot be read.
        """
        key = (str(path), _state_of(path))
        with self._lock:
            if key not in self._open:
                self._open[key] = Playback(path)
            episode = self._open[key] = self._open.pop(key)  # the newest is last
            while len(self._open) > _OPEN:
                self._open.pop(next(iter(self._open))).close()
        return episode

    def close(self) -> None:
        """Close all episodes, at the end and before one is changed."""
        with self._lock:
            opened, self._open = list(self._open.values()), {}
        for each in opened:
            each.close()


def playback(ui: Ui, path: str) -> Playback:
    """The episode that a request names, or `DATASET:N`.

    Raises:
        IbrobotError: if it is outside the opened folders, or cannot be read.
    """
    return ui.keep(Episodes).opened(ui.folders.find(path))


def _state_of(path: Path) -> Any:
    """Names, sizes and times of an episode's files, which show whether it has changed."""
    if not path.is_dir():
        return None
    with os.scandir(path) as entries:
        return tuple(sorted((each.name, each.stat().st_size, each.stat().st_mtime_ns) for each in entries))


def _row(ui: Ui, path: Path) -> dict[str, Any]:
    name = ui.folders.name(path)
    group = path.parent.parent if path.parent.name == "episodes" else path.parent
    row: dict[str, Any] = {
        "path": name, "name": path.name, "group": ui.folders.name(group), "task": "", "duration_s": None,
        "began_s": None, "outcome": "unknown", "finished": False, "mode": "", "robot": "", "problems": [],
        "bytes": sum(file.stat().st_size for file in path.rglob("*") if file.is_file()),
    }  # fmt: skip
    try:
        with closing(installed_plugins().open_episode(path)) as reader:
            summary = reader.summary()
    except IbrobotError as error:
        return {**row, "problems": [str(error)]}
    known = summary.metadata
    return {
        **row, "task": known.get("prompt", ""), "outcome": summary.outcome, "finished": summary.finished,
        "duration_s": round((summary.end_ns - summary.start_ns) / NS_PER_S, 2), "problems": problems_of(summary),
        "began_s": summary.start_ns / NS_PER_S, "mode": known.get("mode", ""), "robot": known.get("robot", ""),
        "trimmed": known.get("trimmed", ""), "marked": known.get("marked", "") == "true",
    }  # fmt: skip
