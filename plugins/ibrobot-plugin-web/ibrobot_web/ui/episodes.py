"""View: recorded episodes: list, play back, trim, judge, delete and undo."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_core.api import IbrobotError
from ibrobot_web.ui.context import Blob, Handler, Ui, text
from ibrobot_web.ui.recordings import episodes_of, find_recordings, paths_of, playback, run_command


def listing(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """All episodes in the opened folders."""
    found = find_recordings(ui.folders.paths)
    rows = [episodes_of(ui).row(ui, path) for path in found.episodes]
    trashes = [ui.folders.name(path) for path in found.trashes]
    return {"episodes": rows, "complete": found.complete, "trashes": trashes}


def trash(ui: Ui, facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What can be undone in a folder, newest first."""
    folder = ui.folders.find(text(facts, "path"))
    rows = json.loads(run_command(ui, "episodes", "trash", str(folder), "--json"))
    return [
        {**row, "path": ui.folders.name(Path(row["path"])), "folder": ui.folders.name(folder)} for row in rows[::-1]
    ]


def facts_of(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """What an episode contains, and the robot's motion."""
    return playback(ui, facts).facts()


def series(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The numbers of a topic over time."""
    return playback(ui, facts).series(text(facts, "topic"))


def picture(ui: Ui, facts: Mapping[str, Any]) -> Blob:
    """A camera's picture at a time; empty if there is none."""
    found = playback(ui, facts).picture(text(facts, "topic"), _seconds(facts, "at_s"))
    return Blob(found.content, found.content_type) if found is not None else Blob(b"", "image/jpeg")


def scene(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The robot's shapes."""
    from ibrobot_web.scene import make_scene

    try:
        description = playback(ui, facts).description(ui.folders.find)
    except IbrobotError as error:
        return {"bodies": [], "meshes": [], "tip": None, "problem": str(error)}
    key = json.dumps(description, sort_keys=True)
    scenes: dict[str, Any] = ui.view_state.setdefault("scenes", {})
    if key not in scenes:
        scenes[key] = make_scene(description)
    found: dict[str, Any] = scenes[key]
    return found


def objects(ui: Ui, facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The objects of a simulated scene, and where they were."""
    return playback(ui, facts).objects(ui.folders.find)


def mark(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Judge episodes."""
    return run_command(ui, "episodes", "mark", *paths_of(ui, facts), text(facts, "outcome"))


def trim(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Replace an episode by a part of it."""
    path = ui.folders.find(text(facts, "path"))
    begin_s, end_s = _seconds(facts, "begin_s"), _seconds(facts, "end_s")
    episodes_of(ui).forget()
    return run_command(ui, "episodes", "trim", str(path), "--in-place", f"--from={begin_s}", f"--to={end_s}")


def delete(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Move episodes to the trash."""
    paths = paths_of(ui, facts)
    episodes_of(ui).forget()
    return run_command(ui, "episodes", "delete", "--to-trash", *paths)


def restore(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Put an original back."""
    folder = ui.folders.find(text(facts, "path"))
    episodes_of(ui).forget()
    return run_command(ui, "episodes", "trash", str(folder), f"--restore={text(facts, 'id')}")


def empty(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Delete what is in a trash for good."""
    return run_command(ui, "episodes", "trash", str(ui.folders.find(text(facts, "path"))), "--empty", "--yes")


def repair(ui: Ui, facts: Mapping[str, Any]) -> str:
    """Repair an unfinished episode."""
    path = ui.folders.find(text(facts, "path"))
    episodes_of(ui).forget()
    return run_command(ui, "episodes", "repair", str(path))


def _seconds(facts: Mapping[str, Any], name: str) -> float:
    try:
        value = float(facts[name])
    except (KeyError, TypeError, ValueError):
        raise IbrobotError(f"{name} must be a number of seconds") from None
    if not 0 <= value < 1e6:
        raise IbrobotError(f"{name} must be from 0 s to 1,000,000 s, got {value:g}")
    return value


ROUTES: dict[str, Handler] = {
    "GET /list": listing, "GET /trash": trash, "GET /open": facts_of, "GET /series": series, "GET /picture": picture,
    "GET /scene": scene, "GET /objects": objects, "POST /mark": mark, "POST /trim": trim, "POST /delete": delete,
    "POST /restore": restore, "POST /empty": empty, "POST /repair": repair,
}  # fmt: skip
