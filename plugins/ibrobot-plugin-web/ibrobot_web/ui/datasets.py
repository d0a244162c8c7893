"""View: datasets: counts, features, statistics and episodes, which are played back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from ibrobot_core.api import IbrobotError, installed_plugins
from ibrobot_web.ui import episodes
from ibrobot_web.ui.context import Handler, Ui, text
from ibrobot_web.ui.recordings import find_recordings, run_command


def listing(ui: Ui, facts: Mapping[str, Any]) -> list[str]:
    """The datasets in the opened folders."""
    return [ui.folders.name(path) for path in find_recordings(ui.folders.paths).datasets]


def info(ui: Ui, facts: Mapping[str, Any]) -> dict[str, Any]:
    """What a dataset contains."""
    if "datasets" not in installed_plugins().commands:
        raise IbrobotError("datasets need a plugin that is not installed: pip install ibrobot-plugin-lerobot")
    path = ui.folders.find(text(facts, "path"))
    found: dict[str, Any] = json.loads(run_command(ui, "datasets", "info", "--json", str(path)))
    return {**found, "path": ui.folders.name(path)}


ROUTES: dict[str, Handler] = {
    "GET /list": listing, "GET /info": info, "GET /open": episodes.facts_of, "GET /series": episodes.series,
    "GET /picture": episodes.picture, "GET /scene": episodes.scene, "GET /objects": episodes.objects,
}  # fmt: skip
