"""View: conversion of episodes into a dataset, by `ibrobot convert`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import NORM_MODES, NoRequest, installed_plugins
from ibrobot_web.ui.context import NamesPaths, Route, Ui
from ibrobot_web.ui.job_runner import Reader
from ibrobot_web.ui.recordings import find_recordings, paths_of


@attrs.frozen(kw_only=True)
class Conversion(NamesPaths):
    """What to convert. An empty text leaves a choice to the command."""

    out: str = option(help="folder of the dataset")
    only: str = option("", choices=("", "all", "interventions", "policy"), help="frames to keep")
    missing: str = option("", choices=("", "skip", "hold", "refuse"), help="what to do about missing samples")
    norm_mode: str = option("", choices=("", *NORM_MODES), help="units of joints")
    outcome: str = option("", choices=("", "success", "failure", "unknown"), help="episodes to keep")
    prompt: str = option("", help="task of all episodes")
    append: bool = option(False, help="whether to add to a dataset")
    success: bool = option(False, help="whether to write a feature that tells success")


def listing(ui: Ui, request: NoRequest) -> dict[str, Any]:
    """Folders with episodes, and how many each has; and the datasets to which episodes can be added."""
    found = find_recordings(ui.folders.paths)
    counts: dict[str, int] = {}
    for path in found.episodes:
        name = ui.folders.name(path.parent)
        counts[name] = counts.get(name, 0) + 1
    return {
        "groups": [{"path": name, "episodes": count} for name, count in counts.items()],
        "datasets": [ui.folders.name(path) for path in found.datasets],
    }


def start(ui: Ui, request: Conversion) -> dict[str, int]:
    """Begin a conversion."""
    if "convert" not in installed_plugins().commands:
        raise IbrobotError("converting needs a plugin that is not installed: pip install ibrobot-plugin-data")
    paths = paths_of(ui, request.paths)
    out = ui.folders.find(request.out)
    if out in ui.folders.paths:
        raise IbrobotError(f"{out}: is an opened folder; choose a new folder in it, e.g. datasets/pick_cube")
    if (out / "meta" / "info.json").is_file() and not request.append:
        raise IbrobotError(f"{ui.folders.name(out)}: has a dataset already; choose “Add to it”, or another folder")
    arguments = ["convert", "--events", f"--out={out}"]
    for name, value in attrs.asdict(request).items():
        if name not in ("paths", "out") and value:
            option_name = f"--{name.replace('_', '-')}"
            arguments.append(option_name if value is True else f"{option_name}={value}")
    known = {"out": ui.folders.name(out), "problems": [], "progress": 0.0}
    job = ui.jobs.start(
        "convert", f"Convert into {ui.folders.name(out)}", [*arguments, *paths], facts=known, read=event_reader()
    )
    return {"number": job.number}


def event_reader() -> Reader:
    """A function that reads the events of `ibrobot convert --events` into facts: progress, text, problems, report."""
    problems: list[dict[str, str]] = []

    def read(line: str) -> Mapping[str, Any] | None:
        event = parse_event(line)
        match event.get("event"):
            case "progress":
                if event.get("error"):
                    problems.append({"episode": str(event["episode"]), "error": str(event["error"])})
                total = max(1, int(event["total_frames"]))
                frames, seconds = event["frames"], event["seconds"]
                return {
                    "progress": min(1.0, int(event["frames"]) / total),
                    "problems": list(problems),
                    "text": f"{event['done']} of {event['of']} episodes, {frames} frames, {seconds:.0f} s",
                }
            case "report":
                return {"progress": 1.0, "report": event, "text": told(event)}
        return None

    return read


def parse_event(line: str) -> Mapping[str, Any]:
    """The event in a line of output; empty if it is another line."""
    if not line.startswith('{"event"'):
        return {}
    try:
        event = json.loads(line)
    except ValueError:
        return {}
    return event if isinstance(event, dict) else {}


def told(report: Mapping[str, Any]) -> str:
    """The result of a conversion in a line."""
    counts = {
        "left out": report["failed"],
        "passed over": report["passed_over"],
        "ticks skipped": report["skipped_ticks"],
        "ticks held": report["held_ticks"],
        "messages lost in recording": report["lost_messages"],
        "without a task": report["without_prompt"],
    }
    others = "".join(f", {name} {count}" for name, count in counts.items() if count)
    size = report["size_bytes"] / 1e6
    episodes = f"{report['episodes']} episode{'' if report['episodes'] == 1 else 's'}"
    return f"{episodes}, {report['frames']} frames{others}; the dataset has {size:.1f} MB"


ROUTES: dict[str, Route[Any]] = {"GET /list": Route(listing, NoRequest), "POST /start": Route(start, Conversion)}
