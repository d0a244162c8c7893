"""What the functions behind the requests of views work with."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, RequestLimits, Service
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


@attrs.frozen
class File:
    """An answer that is a file, of which browsers may ask for parts, e.g. a video."""

    path: Path
    content_type: str


_LIMITS = RequestLimits(values=10_000, text=4_500, depth=3)
_WHOLE = re.compile(r"-?\d{1,18}")


@attrs.frozen(eq=False)
class Route[Q]:
    """How a view answers a request.

    The request, the query of a GET or the JSON object of a POST, is checked against its class before anything runs.
    """

    answer: Callable[[Ui, Q], Any]
    """Returns what JSON can express, a `Blob` or a `File`. It runs in a thread, may block, and raises IbrobotError for
    what the page is to show."""
    request: type[Q]
    """Class of the request, with its fields as `option`."""

    def read_query(self, query: Mapping[str, str]) -> Q:
        """The request in a query, whose values are texts.

        Raises:
            RequestError: if it does not fit.
        """
        attrs.resolve_types(self.request)  # type: ignore[type-var]
        kinds = {field.name: field.type for field in attrs.fields(self.request)}  # type: ignore[arg-type]
        return self.read({name: _typed(text, kinds.get(name)) for name, text in query.items()})

    def read(self, facts: Any) -> Q:
        """The request in a JSON object.

        Raises:
            RequestError: if it does not fit.
        """
        try:
            return Service("", self.request, object, limits=_LIMITS).read(facts)
        except RequestError as error:
            raise RequestError(str(error).removeprefix(": ")) from None


def _typed(text: str, kind: Any) -> Any:
    """A text of a query as the type of its field; the text itself if it is not one."""
    if kind is bool:
        return {"true": True, "false": False}.get(text, text)
    if kind is int and _WHOLE.fullmatch(text):
        return int(text)
    if kind is float:
        try:
            return float(text)
        except ValueError:
            return text
    return text


@attrs.frozen
class NamesPath:
    """A request about a file or folder."""

    path: str = option(help="in an opened folder")


def _some(instance: object, attribute: object, paths: tuple[str, ...]) -> None:
    if not paths:
        raise ValueError("choose at least one")


@attrs.frozen
class NamesPaths:
    """A request about files or folders."""

    paths: tuple[str, ...] = option(validator=_some, help="in opened folders")
