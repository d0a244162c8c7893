"""Requests of views: how they are read, and what their answers are made from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any, get_type_hints

import attrs
from ibrobot_provenance.processes import Jobs

from ibrobot_core.app import RequestError, RequestLimits, Service
from ibrobot_web.ui.folders import Folders


@attrs.frozen(eq=False)
class Ui:
    """The page's server, as views see it."""

    folders: Folders
    jobs: Jobs
    run_options: tuple[str, ...] = ()
    """Options of runs that the page launches, so that their pages are reachable from where this page is."""
    _kept: dict[type[Any], Any] = attrs.field(factory=dict, init=False)

    def keep[T](self, kind: type[T]) -> T:
        """The one object of a class that requests share until the server ends, which closes it. Thread-safe."""
        kept: T = self._kept.setdefault(kind, kind())
        return kept

    def close(self) -> None:
        """End what views and jobs have started."""
        for each in self._kept.values():
            each.close()
        self.jobs.close()


@attrs.frozen
class File:
    """An answer that is a file, e.g. a video; browsers may request parts of it."""

    path: Path
    content_type: str


type Handler = Callable[..., Any]
"""Answers a request: a function of the `Ui`, whose further parameters are the facts of the request.

Bounds and checks of a fact stand in the place of its default, as `option`. It returns what JSON can express, a
`Picture` or a `File`; it runs in a thread, may block, and raises IbrobotError with what the page shows.
"""
type Routes = dict[str, Handler]
"""Method and path below that of the view, e.g. `GET /list` -> what answers it."""
_LIMITS = RequestLimits(values=10_000, text=4_500, depth=3)


@cache
def request_of(handler: Handler) -> type[Any]:
    """The class of the requests that a function answers, with its parameters except the first as fields."""
    kinds = get_type_hints(handler)
    facts = list(signature(handler).parameters.values())[1:]
    fields = {each.name: each.default for each in facts if each.default is not each.empty}
    fields["__annotations__"] = {each.name: kinds[each.name] for each in facts}
    return attrs.frozen(kw_only=True)(type("Request", (), fields))


def read_facts(handler: Handler, facts: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments for a handler from the JSON object of a POST, checked before anything runs.

    Raises:
        RequestError: if they do not fit.
    """
    try:
        request = Service("", request_of(handler), object, limits=_LIMITS).read(facts)
    except RequestError as error:
        raise RequestError(str(error).removeprefix(": ")) from None
    return attrs.asdict(request, recurse=False)


def read_query(handler: Handler, query: Mapping[str, str]) -> dict[str, Any]:
    """As `read_facts`, from the query of a GET, whose values are texts.

    Raises:
        RequestError: if they do not fit.
    """
    kinds = get_type_hints(handler)
    return read_facts(handler, {name: _typed(text, kinds.get(name)) for name, text in query.items()})


def _typed(text: str, kind: Any) -> Any:
    """A text of a query as the type of its field; the text itself if it is not one."""
    try:
        return json.loads(text) if kind in (bool, int, float) else text
    except (ValueError, RecursionError):
        return text
