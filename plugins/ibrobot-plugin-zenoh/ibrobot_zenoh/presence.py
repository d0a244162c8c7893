"""Presence of servers: every server declares a token, which Zenoh removes when the server dies."""

from __future__ import annotations

import threading
from collections.abc import Callable

import zenoh
from ibrobot_ros2.workers import Workers

from ibrobot_zenoh.access import SERVED
from ibrobot_zenoh.connection import Connection

PREFIX = f"{SERVED}/"
"""Tokens are PREFIX NAME / ID."""


class Presence:
    """Tracks all present tokens with one subscription for all names."""

    def __init__(self, connection: Connection) -> None:
        self._lock = threading.Lock()
        self._alive: dict[str, set[str]] = {}
        self._watches: dict[str, list[Workers[bool]]] = {}
        connection.declare(
            lambda session: session.liveliness().declare_subscriber(f"{PREFIX}**", self._take, history=True)
        )

    def watch(self, name: str, changed: Callable[[bool], object]) -> tuple[Callable[[], None], Workers[bool]]:
        """See `Transport.watch`; returns a function that ends the watch, and the thread that calls `changed`."""
        turn = threading.Lock()  # the present state must be delivered before any change

        def notify(served: bool) -> None:
            with turn:
                changed(served)

        watch = Workers(notify, f"a watch of {name}")
        with turn:
            with self._lock:
                served = bool(self._alive.get(name))
                self._watches.setdefault(name, []).append(watch)
            changed(served)

        def end() -> None:
            with self._lock:
                if watch in self._watches[name]:
                    self._watches[name].remove(watch)

        return end, watch

    def served(self, prefix: str) -> frozenset[str]:
        """The names with this prefix that have a token."""
        with self._lock:
            return frozenset(name for name in self._alive if name.startswith(prefix))

    def _take(self, sample: zenoh.Sample) -> None:
        name, _, token = str(sample.key_expr).removeprefix(PREFIX).rpartition("/")
        with self._lock:
            tokens = self._alive.setdefault(name, set())
            before = bool(tokens)
            if sample.kind == zenoh.SampleKind.PUT:
                tokens.add(token)
            else:
                tokens.discard(token)
            if bool(tokens) != before:
                for watch in self._watches.get(name, ()):
                    watch.put(not before)
            if not tokens:
                del self._alive[name]
