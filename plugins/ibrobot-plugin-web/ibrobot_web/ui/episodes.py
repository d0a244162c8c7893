"""View: recorded episodes: list, play back, trim, judge, delete and undo."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_web.pictures import Picture
from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.forms import choices_of, run_command
from ibrobot_web.ui.recordings import Episodes, find_recordings, playback

_LONGEST_S = 1e6


def _some(instance: object, attribute: object, paths: tuple[str, ...]) -> None:
    if not paths:
        raise ValueError("choose at least one")


def listing(ui: Ui) -> dict[str, Any]:
    """All episodes in the opened folders."""
    recordings = find_recordings(ui.folders)
    rows = [ui.keep(Episodes).row(ui, path) for path in recordings.episodes]
    trashes = [ui.folders.name(path) for path in recordings.trashes]
    outcomes = choices_of("episodes mark", "outcome")
    return {"episodes": rows, "complete": recordings.complete, "trashes": trashes, "outcomes": outcomes}


def trash(ui: Ui, path: str) -> list[dict[str, Any]]:
    """What can be undone in a folder, newest first."""
    trashed = run_command(ui, "episodes trash", path=path)
    folder = ui.folders.name(ui.folders.find(path))
    rows = [{**attrs.asdict(each), "what": each.shown().text} for each in trashed]
    return [{**row, "path": ui.folders.name(Path(row["path"])), "folder": folder} for row in rows[::-1]]


def facts_of(ui: Ui, path: str) -> dict[str, Any]:
    """What an episode contains, and the robot's motion."""
    return playback(ui, path).facts()


def series(ui: Ui, path: str, topic: str) -> dict[str, Any]:
    """The numbers of a topic over time."""
    return playback(ui, path).series(topic)


def picture(ui: Ui, path: str, topic: str, at_s: float = option(unit="s", ge=0, le=_LONGEST_S)) -> Picture:
    """A camera's picture at a time; empty if there is none."""
    return playback(ui, path).picture(topic, at_s) or Picture(b"", "image/jpeg")


def scene(ui: Ui, path: str) -> dict[str, Any]:
    """The robot's shapes."""
    try:
        return _scene(json.dumps(playback(ui, path).description(ui.folders.find), sort_keys=True))
    except IbrobotError as error:
        return {"bodies": [], "meshes": [], "tips": {}, "problem": str(error)}


@functools.cache
def _scene(description: str) -> dict[str, Any]:
    from ibrobot_web.scene import make_scene

    return make_scene(json.loads(description))


def objects(ui: Ui, path: str) -> list[dict[str, Any]]:
    """The objects of a simulated scene, and where they were."""
    return playback(ui, path).objects(ui.folders.find)


def mark(ui: Ui, outcome: str, paths: tuple[str, ...] = option(validator=_some)) -> None:
    """Judge episodes."""
    run_command(ui, "episodes mark", episodes=list(paths), outcome=outcome)


def trim(
    ui: Ui, path: str, begin_s: float = option(unit="s", ge=0, le=_LONGEST_S),
    end_s: float = option(unit="s", ge=0, le=_LONGEST_S),
) -> None:  # fmt: skip
    """Replace an episode by a part of it, in times since its begin."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes trim", episode=path, in_place=True, begin_s=begin_s, end_s=end_s)


def delete(ui: Ui, paths: tuple[str, ...] = option(validator=_some)) -> None:
    """Move episodes to the trash."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes delete", episodes=list(paths), to_trash=True)


def restore(ui: Ui, path: str, id: str) -> None:
    """Put an original back, by its id in the trash."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes trash", path=path, restore=id)


def empty(ui: Ui, path: str) -> None:
    """Delete what is in a trash for good."""
    run_command(ui, "episodes trash", path=path, empty=True, yes=True)


def repair(ui: Ui, path: str) -> None:
    """Repair an unfinished episode."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes repair", path=path)


ROUTES: Routes = {
    "GET /list": listing, "GET /trash": trash,
    "GET /open": facts_of, "GET /series": series,
    "GET /picture": picture, "GET /scene": scene,
    "GET /objects": objects, "POST /mark": mark, "POST /trim": trim,
    "POST /delete": delete, "POST /restore": restore,
    "POST /empty": empty, "POST /repair": repair,
}  # fmt: skip
