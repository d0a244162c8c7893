"""What the functions behind the requests of views work with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.job_runner import Jobs


@attrs.frozen(eq=False)
class Ui:
    """The page's server, as views see it."""

    folders: Folders
    jobs: Jobs
    run_options: tuple[str, ...] = ()
    """Options of runs that the page launches, so that their pages are reachable from where this page is."""
    view_state: dict[str, Any] = attrs.field(factory=dict)
    """What views keep between requests, by the view's name; use locks, since requests run in threads."""
    closers: list[Callable[[], None]] = attrs.field(factory=list)
    """Called when the server ends."""

    def close(self) -> None:
        """End what views and jobs have started."""
        for close in self.closers:
            close()
        self.jobs.close()


@attrs.frozen
class Blob:
    """An answer that is not JSON, e.g. a picture."""

    content: bytes
    content_type: str


Handler = Callable[[Ui, Mapping[str, Any]], Any]
"""Answers a request. It gets the query of a GET, whose values are texts, or the JSON object of a POST, and returns what
JSON can express, or a `Blob`. It runs in a thread, may block, and raises IbrobotError for what the page is to show."""


def text(facts: Mapping[str, Any], name: str, default: str | None = None) -> str:
    """A text of a request.

    Raises:
        IbrobotError: if it is missing and has no default, or is of another type.
    """
    value = facts.get(name, default)
    if not isinstance(value, str):
        raise IbrobotError(f"{name} must be a text" if name in facts else f"{name} is missing")
    return value


def integer(facts: Mapping[str, Any], name: str, *, default: int | None = None, least: int = 0) -> int:
    """A whole number of a request, as JSON or as the text of a query.

    Raises:
        IbrobotError: if it is missing and has no default, is of another type, or too small.
    """
    value = facts.get(name, default)
    if isinstance(value, str):
        try:
            value = int(value)
        except ValueError:
            value = None
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise IbrobotError(f"{name} must be a whole number from {least}; it is {facts.get(name)!r}")
    return value


def flag(facts: Mapping[str, Any], name: str) -> bool:
    """A switch of a request; off if it is missing.

    Raises:
        IbrobotError: if it is of another type.
    """
    value = facts.get(name, False)
    if not isinstance(value, bool):
        raise IbrobotError(f"{name} must be true or false")
    return value
