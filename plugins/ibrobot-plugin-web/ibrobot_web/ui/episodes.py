"""View: recorded episodes: list, play back, trim, judge, delete and undo."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import NoRequest
from ibrobot_web.pictures import Picture
from ibrobot_web.ui.context import NamesPath, NamesPaths, Route, Ui
from ibrobot_web.ui.forms import choices_of, run_command
from ibrobot_web.ui.recordings import Episodes, existing, find_recordings, playback

_LONGEST_S = 1e6


@attrs.frozen
class NamesTopic(NamesPath):
    """A request about a topic of an episode."""

    topic: str = option(help="its name")


@attrs.frozen
class NamesPicture(NamesTopic):
    """A request for a picture."""

    at_s: float = option(unit="s", ge=0, le=_LONGEST_S, help="time since the episode's begin")


@attrs.frozen
class Mark(NamesPaths):
    """How episodes went."""

    outcome: str = option(help="of all of them")


@attrs.frozen
class Trim(NamesPath):
    """The part of an episode to keep."""

    begin_s: float = option(unit="s", ge=0, le=_LONGEST_S, help="its begin, since the episode's")
    end_s: float = option(unit="s", ge=0, le=_LONGEST_S, help="its end, since the episode's begin")


@attrs.frozen
class Restore(NamesPath):
    """What to put back."""

    id: str = option(help="as the trash lists it")


def listing(ui: Ui, request: NoRequest) -> dict[str, Any]:
    """All episodes in the opened folders."""
    found = find_recordings(ui.folders)
    rows = [ui.keep(Episodes).row(ui, path) for path in found.episodes]
    trashes = [ui.folders.name(path) for path in found.trashes]
    outcomes = choices_of("episodes mark", "outcome")
    return {"episodes": rows, "complete": found.complete, "trashes": trashes, "outcomes": outcomes}


def trash(ui: Ui, request: NamesPath) -> list[dict[str, Any]]:
    """What can be undone in a folder, newest first."""
    found = run_command(ui, "episodes trash", path=request.path)
    folder = ui.folders.name(ui.folders.find(request.path))
    rows = [{**attrs.asdict(each), "what": each.shown().text} for each in found]
    return [{**row, "path": ui.folders.name(Path(row["path"])), "folder": folder} for row in rows[::-1]]


def facts_of(ui: Ui, request: NamesPath) -> dict[str, Any]:
    """What an episode contains, and the robot's motion."""
    return playback(ui, request.path).facts()


def series(ui: Ui, request: NamesTopic) -> dict[str, Any]:
    """The numbers of a topic over time."""
    return playback(ui, request.path).series(request.topic)


def picture(ui: Ui, request: NamesPicture) -> Picture:
    """A camera's picture at a time; empty if there is none."""
    return playback(ui, request.path).picture(request.topic, request.at_s) or Picture(b"", "image/jpeg")


def scene(ui: Ui, request: NamesPath) -> dict[str, Any]:
    """The robot's shapes."""
    try:
        return _scene(json.dumps(playback(ui, request.path).description(ui.folders.find), sort_keys=True))
    except IbrobotError as error:
        return {"bodies": [], "meshes": [], "tips": {}, "problem": str(error)}


@functools.cache
def _scene(description: str) -> dict[str, Any]:
    from ibrobot_web.scene import make_scene

    return make_scene(json.loads(description))


def objects(ui: Ui, request: NamesPath) -> list[dict[str, Any]]:
    """The objects of a simulated scene, and where they were."""
    return playback(ui, request.path).objects(ui.folders.find)


def mark(ui: Ui, request: Mark) -> None:
    """Judge episodes."""
    run_command(ui, "episodes mark", episodes=existing(ui, request.paths), outcome=request.outcome)


def trim(ui: Ui, request: Trim) -> None:
    """Replace an episode by a part of it."""
    ui.keep(Episodes).close()
    begin_s, end_s = request.begin_s, request.end_s
    run_command(ui, "episodes trim", episode=request.path, in_place=True, begin_s=begin_s, end_s=end_s)


def delete(ui: Ui, request: NamesPaths) -> None:
    """Move episodes to the trash."""
    paths = existing(ui, request.paths)
    ui.keep(Episodes).close()
    run_command(ui, "episodes delete", episodes=paths, to_trash=True)


def restore(ui: Ui, request: Restore) -> None:
    """Put an original back."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes trash", path=request.path, restore=request.id)


def empty(ui: Ui, request: NamesPath) -> None:
    """Delete what is in a trash for good."""
    run_command(ui, "episodes trash", path=request.path, empty=True, yes=True)


def repair(ui: Ui, request: NamesPath) -> None:
    """Repair an unfinished episode."""
    ui.keep(Episodes).close()
    run_command(ui, "episodes repair", path=request.path)


ROUTES: dict[str, Route[Any]] = {
    "GET /list": Route(listing, NoRequest), "GET /trash": Route(trash, NamesPath),
    "GET /open": Route(facts_of, NamesPath), "GET /series": Route(series, NamesTopic),
    "GET /picture": Route(picture, NamesPicture), "GET /scene": Route(scene, NamesPath),
    "GET /objects": Route(objects, NamesPath), "POST /mark": Route(mark, Mark), "POST /trim": Route(trim, Trim),
    "POST /delete": Route(delete, NamesPaths), "POST /restore": Route(restore, Restore),
    "POST /empty": Route(empty, NamesPath), "POST /repair": Route(repair, NamesPath),
}  # fmt: skip
