"""View: datasets: counts, features, statistics and episodes, which are played back."""

from __future__ import annotations

import json
from typing import Any

from ibrobot_core.app import NoRequest, installed_plugins
from ibrobot_web.ui import episodes
from ibrobot_web.ui.context import NamesPath, Route, Ui
from ibrobot_web.ui.recordings import find_recordings, run_command


def listing(ui: Ui, request: NoRequest) -> list[str]:
    """The datasets in the opened folders."""
    return [ui.folders.name(path) for path in find_recordings(ui.folders.paths).datasets]


def info(ui: Ui, request: NamesPath) -> dict[str, Any]:
    """What a dataset contains."""
    installed_plugins().command("datasets")  # raises the error that names its package
    path = ui.folders.find(request.path)
    found: dict[str, Any] = json.loads(run_command(ui, "datasets", "info", "--json", str(path)))
    return {**found, "path": ui.folders.name(path)}


ROUTES: dict[str, Route[Any]] = {
    "GET /list": Route(listing, NoRequest),
    "GET /info": Route(info, NamesPath),
    **{f"GET /{name}": episodes.ROUTES[f"GET /{name}"] for name in ("open", "series", "picture", "scene", "objects")},
}
