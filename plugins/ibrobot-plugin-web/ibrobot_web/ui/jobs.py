"""View: all jobs, with their output; other views show those of their kind."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.api import option
from ibrobot_web.ui.context import Route, Ui


@attrs.frozen
class NamesJob:
    """A request about a job."""

    number: int = option(ge=1, help="its number")


def cancel(ui: Ui, request: NamesJob) -> None:
    """End a job as Ctrl-C does; the second time at once."""
    ui.jobs.cancel(request.number)


ROUTES: dict[str, Route[Any]] = {"POST /cancel": Route(cancel, NamesJob)}
