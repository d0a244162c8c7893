"""View: recording sessions. A run that records, with the number of episodes still to come and the disk's free space."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import installed_plugins
from ibrobot_web.ui.context import Route, Ui
from ibrobot_web.ui.robots import RUN_DONE, Launch, read_address, run_arguments

_DATASET = re.compile(r"\w[\w .-]*(?:/\w[\w .-]*)*")
_LONGEST_PROMPT = 500
_STATUS = re.compile(r"\| (?P<state>[^|]*), saved (?P<saved>\d+) of (?P<count>\d+)$")
"""The end of a status line of `ibrobot record`."""
_SUMMARY = re.compile(r"recorded +(?P<saved>\d+) of (?P<count>\d+) episodes? into")
"""The line of its summary."""


@attrs.frozen
class NamesDataset:
    """A request about a dataset of episodes."""

    dataset: str = option("default", help="its name")
    root: str = option("episodes", help="folder of all datasets")


@attrs.frozen(kw_only=True)
class RecordSession(Launch):
    """What to record."""

    episodes: int = option(ge=1, le=100_000, help="number of episodes")
    prompt: str = option("", help="the task")
    dataset: str = option("default", help="name of the dataset")
    root: str = option("episodes", help="folder of all datasets")


def place(ui: Ui, request: NamesDataset) -> dict[str, Any]:
    """Where episodes go, how many the dataset has, how large they are, and the disk's free space."""
    folder = _folder(ui, request.root, request.dataset)
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


def start(ui: Ui, request: RecordSession) -> dict[str, int]:
    """Begin a session: `ibrobot record`, which ends by itself after the last episode."""
    installed_plugins().command("record")  # raises the error that names its package
    prompt, count = request.prompt, request.episodes
    if len(prompt) > _LONGEST_PROMPT:
        raise IbrobotError(f"the task has {len(prompt)} characters; at most {_LONGEST_PROMPT} are possible")
    folder = _folder(ui, request.root, request.dataset)
    root = ui.folders.find(request.root)
    arguments = [
        "record",
        *run_arguments(ui, request),
        f"--root={root}",
        f"--dataset={folder.relative_to(root)}",
        f"--prompt={prompt}",
        f"--episodes={count}",
    ]
    known = {"dataset": ui.folders.name(folder), "saved": 0, "episodes": count, "progress": 0.0}
    job = ui.jobs.start(
        "record", f"Record {folder.name}", arguments, facts=known, read=read_status, done_codes=RUN_DONE
    )
    return {"number": job.number}


def _folder(ui: Ui, root: str, dataset: str) -> Path:
    """The dataset's folder."""
    dataset = dataset.strip()
    if _DATASET.fullmatch(dataset) is None:
        raise IbrobotError(f"dataset {dataset!r}: use letters, digits, spaces, dots, - and _, e.g. pick_cube")
    return ui.folders.find(str(Path(root) / dataset))


def read_status(line: str) -> Mapping[str, Any] | None:
    """The progress of a session, or the address of its page, from a line of its output."""
    if (status := _STATUS.search(line)) is not None:
        saved, count = int(status["saved"]), int(status["count"])
        return {
            "saved": saved,
            "progress": saved / count,
            "text": f"{status['state']} · {saved} of {count} episodes saved",
        }
    if (summary := _SUMMARY.match(line)) is not None:
        saved, count = int(summary["saved"]), int(summary["count"])
        return {"saved": saved, "progress": saved / count, "text": f"{saved} of {count} episodes saved"}
    return read_address(line)


ROUTES: dict[str, Route[Any]] = {"GET /place": Route(place, NamesDataset), "POST /start": Route(start, RecordSession)}
