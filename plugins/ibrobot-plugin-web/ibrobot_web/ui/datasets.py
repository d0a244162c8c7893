"""View: datasets: counts, features, statistics and episodes, which are played back."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.app import NoRequest
from ibrobot_web.ui.context import NamesPath, Route, Ui
from ibrobot_web.ui.forms import run_command
from ibrobot_web.ui.recordings import find_recordings


def listing(ui: Ui, request: NoRequest) -> list[str]:
    """The datasets in the opened folders."""
    return [ui.folders.name(path) for path in find_recordings(ui.folders).datasets]


def info(ui: Ui, request: NamesPath) -> dict[str, Any]:
    """What a dataset contains."""
    (found,) = run_command(ui, "datasets info", dataset=request.path)
    return {**attrs.asdict(found), "path": ui.folders.name(ui.folders.find(request.path))}


ROUTES: dict[str, Route[Any]] = {
    "GET /list": Route(listing, NoRequest),
    "GET /info": Route(info, NamesPath),
}
