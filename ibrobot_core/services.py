"""Services: declared by a name and the classes of request and answer, served and called in a table of a process."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, overload

import attrs

from ibrobot_core.convert import MOST, Converter, Faults, Key, error_message, no_files, shown
from ibrobot_core.errors import RequestError, TransportError
from ibrobot_core.options import fields

type Plain = bool | int | float | str | Sequence[Plain] | Mapping[str, Plain] | None
"""A JSON value. Nothing in it is expanded: neither `${NAME}`, nor `~`, nor YAML in a text."""

_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters, and halves of characters, which no file and no terminal takes."""
_INTEGERS = range(-(2**63), 2**63)


@attrs.frozen
class RequestLimits:
    """Bounds on a plain request, which are checked before anything else."""

    values: int = 2_000
    """Number of values: lists, mappings, and what they contain."""
    text: int = 1_000
    """Characters of a text, and of a key."""
    depth: int = 10
    """Lists and mappings within one another."""


@attrs.frozen
class NoRequest:
    """The request to a service that needs nothing."""


@attrs.frozen(eq=False)
class Service[Q, A]:
    """A service, declared by its owner.

    Its request is an object of a frozen attrs class, whose fields (`option`) state units, bounds and help. Callers from
    outside send the same as plain data.
    """

    name: str
    """E.g. `/planning/go_to`."""
    request: type[Q]
    """Class of the request."""
    answer: type[A] | UnionType
    """Type of the answer."""
    help: str = ""
    """One sentence that says what it does."""
    alone: str = ""
    """The field that a plain request without keys stands for, e.g. `pose` if `home` means `{pose: home}`."""
    limits: RequestLimits = RequestLimits()
    urgent: bool = False
    """Whether it must not wait behind other requests, as an emergency stop."""
    reads: bool = False
    """Whether it changes nothing and moves nothing, so that a request may be answered however late it arrives."""
    persons: bool = False
    """Whether it is for persons only: no agent may call it, whatever was granted."""
    ros_type: str = ""
    """The ROS 2 type with the same fields, if there is one, e.g. `ibrobot_msgs/srv/MoveToPose`, or an action."""
    progress: Service[NoRequest, Any] | None = None
    """For a service that takes its time: answers with what it has done so far, which is an action's feedback."""
    result: Service[Any, Any] | None = None
    """For a service that answers with a number at once: answers for this number with the result, or null until then."""
    cancel: Service[NoRequest, Any] | None = None
    """For a service that takes its time: ends it early; it then answers its caller."""

    def __attrs_post_init__(self) -> None:
        if not attrs.has(self.request):
            raise TypeError(f"{self.name}: the request must be an attrs class, got {self.request}")

    def read(self, request: Q | Plain, files: Callable[[str], Path] = no_files) -> Q:
        """A request as an object of its class.

        Args:
            request: such an object, or plain data.
            files: finds the file that a text names; raises ValueError for files that no request may name.

        Raises:
            RequestError: for data that does not fit, with every fault: its key, the value, and what would be right.
        """
        if isinstance(request, self.request):
            return request
        if not (faults := _too_much(request, self.limits)):
            values: Any = {} if request is None else request
            if self.alone and not isinstance(values, Mapping):
                values = {self.alone: values}
            if not isinstance(values, Mapping):
                keys = ", ".join(fields(self.request))
                expected = f"a mapping with {keys}" if keys else "nothing"
                raise RequestError(f"{self.name}: expected {expected}, got {shown(values)}")
            try:
                return Converter(files, MOST + 1).structure(values, self.request)  # type: ignore[no-any-return]
            except Faults as error:
                faults = error.found
            except (ValueError, TypeError, ArithmeticError) as error:  # values that exclude each other
                faults = [((), error_message(error))]
        raise RequestError(f"{self.name}: {Faults(faults)}")


@attrs.frozen(eq=False)
class _Server[Q, A]:
    """A service, and what answers its calls."""

    service: Service[Q, A]
    handler: Callable[[Q], A]
    files: Callable[[str], Path]


class ServiceTable:
    """The services of a process, by name: what serves and calls them. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._servers: dict[str, _Server[Any, Any]] = {}

    def serve[Q, A](
        self, service: Service[Q, A], handler: Callable[[Q], A], files: Callable[[str], Path] = no_files
    ) -> None:
        """Answer calls of a service with `handler`, in the caller's thread.

        Args:
            service: the service.
            handler: computes the answer to a request, which fits the service's class.
            files: finds the file that a text in a plain request names; see `Service.read`.

        Raises:
            TransportError: if the service is served already.
        """
        with self._lock:
            if service.name in self._servers:
                raise TransportError(f"service {service.name} is served already")
            self._servers[service.name] = _Server(service, handler, files)

    def unserve(self, service: Service[Any, Any] | str) -> None:
        """Stop serving a service; does nothing if it is not served."""
        with self._lock:
            self._servers.pop(_name(service), None)

    def serves(self, service: Service[Any, Any] | str) -> bool:
        """Whether a service is served."""
        with self._lock:
            return _name(service) in self._servers

    def services(self) -> dict[str, Service[Any, Any]]:
        """The served services by name, sorted."""
        with self._lock:
            return {name: server.service for name, server in sorted(self._servers.items())}

    @overload
    def call[Q, A](self, service: Service[Q, A], request: Q) -> A: ...

    @overload
    def call[A](self, service: Service[Any, A], request: Plain = None) -> A: ...

    @overload
    def call(self, service: str, request: Any = None) -> Any: ...

    def call(self, service: Service[Any, Any] | str, request: Any = None) -> Any:
        """Call a service, given by its declaration or its name, with an object of its request's class or plain data.

        Raises:
            TransportError: if it has no server.
            RequestError: for plain data that does not fit.
        """
        name = _name(service)
        with self._lock:
            server = self._servers.get(name)
        if server is None:
            raise TransportError(f"nobody serves {name}; served: {', '.join(self.services()) or 'nothing'}")
        return server.handler(server.service.read(request, server.files))


def _too_much(request: object, limits: RequestLimits) -> list[tuple[Key, str]]:
    """The first value that is beyond the limits, or is no plain data, with its fault."""
    left = limits.values
    todo: list[tuple[Key, object]] = [((), request)]
    while todo:
        key, value = todo.pop()
        left -= 1
        wrong = _misfit(value, limits)
        if isinstance(value, Mapping | list | tuple) and not wrong:
            if len(value) > left:
                return [((), f"the request has more than {limits.values} values")]
            if value and len(key) >= limits.depth:
                return [(key, f"more than {limits.depth} lists and mappings within one another")]
            keys = tuple(value) if isinstance(value, Mapping) else ()
            wrong = next((misfit for part in keys if (misfit := _key_misfit(part, limits))), "")
            items = value.items() if isinstance(value, Mapping) else enumerate(value)
            todo += [((*key, part), item) for part, item in items]
        if wrong:
            return [(key, wrong)]
    return []


def _misfit(value: object, limits: RequestLimits) -> str:
    """Why a value cannot be part of a request; empty if it can."""
    if not isinstance(value, bool | int | float | str | list | tuple | Mapping | None):
        return f"a {type(value).__name__} is no plain data: text, numbers, lists and mappings"
    if isinstance(value, str) and len(value) > limits.text:
        return f"a text of {len(value)} characters, at most {limits.text} are allowed"
    if isinstance(value, str) and _UNPRINTABLE.search(value):
        return f"{shown(value)} has control characters"
    if isinstance(value, int) and value not in _INTEGERS:
        return "a whole number of more than 64 bits"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value} is not a finite number"
    return ""


def _key_misfit(key: object, limits: RequestLimits) -> str:
    """Why a key cannot be part of a request; empty if it can."""
    return _misfit(key, limits) if isinstance(key, str) else f"{shown(key)} is no key: a key is a text"


def _name(service: Service[Any, Any] | str) -> str:
    return service if isinstance(service, str) else service.name
