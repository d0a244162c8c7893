"""View: datasets: counts, features, statistics and episodes, which are played back."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_web.ui.context import Routes, Ui
from ibrobot_web.ui.forms import run_command
from ibrobot_web.ui.recordings import find_recordings


def listing(ui: Ui) -> list[str]:
    """The datasets in the opened folders."""
    return [ui.folders.name(path) for path in find_recordings(ui.folders).datasets]


def info(ui: Ui, path: str) -> dict[str, Any]:
    """What a dataset contains."""
    (dataset,) = run_command(ui, "datasets info", dataset=path)
    return {**attrs.asdict(dataset), "path": ui.folders.name(ui.folders.find(path))}


ROUTES: Routes = {
    "GET /list": listing,
    "GET /info": info,
}
