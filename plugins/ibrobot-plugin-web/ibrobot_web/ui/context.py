"""Requests of views: how they are read, and what their answers are made from."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, RequestLimits, Service
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.job_runner import Jobs


class Closes(Protocol):
    """What ends with the server."""

    def close(self) -> None:
        """End it."""


@attrs.frozen(eq=False)
class Ui:
    """The page's server, as views see it."""

    folders: Folders
    jobs: Jobs
    run_options: tuple[str, ...] = ()
    """Options of runs that the page launches, so that their pages are reachable from where this page is."""
    _kept: dict[type[Any], Any] = attrs.field(factory=dict, init=False)
    _lock: threading.Lock = attrs.field(factory=threading.Lock, init=False)

    def keep[T: Closes](self, kind: type[T]) -> T:
        """The one object of a class that requests share until the server ends, made at the first call."""
        with self._lock:
            if kind not in self._kept:
                self._kept[kind] = kind()
            found: T = self._kept[kind]
        return found

    def close(self) -> None:
        """End what views and jobs have started."""
        for each in self._kept.values():
            each.close()
        self.jobs.close()


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
    """Returns what JSON can express, a `Picture` or a `File`. It runs in a thread, may block, and raises IbrobotError
    with what the page shows."""
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
