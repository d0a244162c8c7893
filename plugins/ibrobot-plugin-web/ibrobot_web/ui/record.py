"""View: recording sessions. A run that records, with the number of episodes still to come and the disk's free space."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_provenance.processes import arguments

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import installed_plugins
from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.forms import read_form
from ibrobot_web.ui.jobs import event_reader
from ibrobot_web.ui.robots import RUN_DONE, read_address, run_arguments

_COMMAND = "record"
_ROOT = "episodes"
"""Folder of all datasets that are recorded by the page, in the first folder."""
_DATASET = re.compile(r"\w[\w .-]*(?:/\w[\w .-]*)*")


def place(ui: Ui, dataset: str = "default") -> dict[str, Any]:
    """Where episodes go, how many the dataset has, how large they are, and the disk's free space."""
    folder = _folder(ui, dataset)
    episodes = [path for path in (folder / "episodes").glob("episode_*") if path.is_dir()]
    sizes = [sum(each.stat().st_size for each in path.rglob("*") if each.is_file()) for path in episodes]
    existing = folder
    while not existing.exists():
        existing = existing.parent
    return {
        "folder": ui.folders.name(folder),
        "episodes": len(episodes),
        "free_bytes": shutil.disk_usage(existing).free,
        "episode_bytes": round(sum(sizes) / len(sizes)) if sizes else None,
    }


def start(ui: Ui, robot: str, values: Mapping[str, Any], sim: bool = False, mode: str = "") -> dict[str, int]:
    """Begin a session: `ibrobot record`, which ends by itself after the last episode."""
    command = installed_plugins().command(_COMMAND)
    # Options of the conversion are suggested whether or not one is asked for.
    given = {name: value for name, value in values.items() if values.get("convert") or not name.startswith("convert_")}
    folder = _folder(ui, str(given.pop("dataset", None) or "default"))
    root = ui.folders.find(_ROOT)
    options = read_form(ui, command, given)
    place = (f"--root={root}", f"--dataset={folder.relative_to(root)}")
    read_event = event_reader(ui.folders, command)
    job = ui.jobs.start(
        _COMMAND,
        f"Record {folder.name}",
        [_COMMAND, "--events", *run_arguments(ui, robot, sim, mode), *place, *arguments(options)],
        read=lambda line: event if (event := read_event(line)) is not None else read_address(line),
        done_codes=RUN_DONE,
    )
    return {"number": job.number}


def _folder(ui: Ui, dataset: str) -> Path:
    """The dataset's folder."""
    dataset = dataset.strip()
    if _DATASET.fullmatch(dataset) is None:
        raise IbrobotError(f"dataset {dataset!r}: use letters, digits, spaces, dots, - and _, e.g. pick_cube")
    return ui.folders.find(str(Path(_ROOT) / dataset))


ROUTES: Routes = {
    "GET /place": place,
    "POST /start": start,
}
