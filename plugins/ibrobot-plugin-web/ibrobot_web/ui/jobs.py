"""View: all jobs, with their output; other views show those of their kind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ibrobot_web.ui.context import Handler, Ui


def cancel(ui: Ui, facts: Mapping[str, Any]) -> None:
    """End a job as Ctrl-C does; the second time at once."""
    ui.jobs.cancel(facts.get("number"))


ROUTES: dict[str, Handler] = {"POST /cancel": cancel}
