"""A Zenoh session that connects when a peer answers, and restores its declarations."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any, Protocol
from weakref import WeakSet

import zenoh

from ibrobot_core.api import TransportError
from ibrobot_core.app import set_malloc
from ibrobot_zenoh.access import restrict
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.reasons import tls_context, why_not

_RETRY_MS = (50, 200)
"""First and longest time between attempts to connect [s]."""
_BATCHES, _RECEIVED_AT_ONCE = 16, 256 << 10
"""Number of 64 kB buffers of a large message in front of the socket, and the size of a read [bytes].

With Zenoh's defaults, two and 64 kB, its threads wake one another for every piece of a camera image, which takes a
quarter of the time of a request.
"""
_ACCEPT_MS, _ACCEPTED = 3000, 4000
"""How long a new connection may take to authenticate [ms], and how many may do so at once."""
_CLOSE_WAIT_S = 1.0
"""How long `close` waits for an attempt to connect, which cannot be interrupted [s]."""
_ASK_WHY_S = 2.0
"""How often to diagnose why there is no connection [s]."""
_FIRST_WAIT_S = 0.3
"""How long the constructor of a client waits for a peer to answer, so that it is usable at once [s]."""

_LARGEST_KEPT, _KEPT_BYTES = 32 << 20, 256 << 20
"""Freed memory for glibc to keep [bytes]: mapping it for each large message costs more than the copies."""


class Declared(Protocol):
    """A subscriber, queryable or token."""

    def undeclare(self) -> Any:
        """End it."""


def zenoh_config(options: ZenohOptions) -> zenoh.Config:
    """Zenoh's settings: the user's own file, overridden by the options, without any scouting.

    Raises:
        TransportError: if a file cannot be read, or certificates do not belong together.
    """
    try:
        config = zenoh.Config() if options.settings is None else zenoh.Config.from_file(options.settings)
    except zenoh.ZError as error:
        raise TransportError(f"settings {options.settings}: {first_line(error)}") from error
    client = options.mode == "client"
    first_ms, longest_ms = _RETRY_MS
    lease_ms = round(options.lease * 1000)
    settings: dict[str, Any] = {
        "mode": options.mode,
        "connect/endpoints": list(options.connect),
        "connect/timeout_ms": 0 if client else -1,
        "connect/exit_on_failure": client,
        "connect/retry": {"period_init_ms": first_ms, "period_max_ms": longest_ms, "period_increase_factor": 2},
        "listen/endpoints": list(options.listen),
        "listen/exit_on_failure": True,
        "open/return_conditions": {"connect_scouted": False, "declares": client},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "timestamping/enabled": True,  # latched topics need it
        "transport/unicast/accept_timeout": _ACCEPT_MS,
        "transport/unicast/accept_pending": _ACCEPTED,
        "transport/link/tx/lease": lease_ms,
        "transport/link/rx/max_message_size": options.max_message_size,
        "transport/shared_memory/enabled": options.shared_memory,
    }
    if options.settings is None:
        settings["transport/link/tx/queue/size"] = dict.fromkeys(("interactive_high", "data"), _BATCHES)
        settings["transport/link/rx/buffer_size"] = _RECEIVED_AT_ONCE
    if (tls := options.tls) is not None:
        tls_context(tls)
        settings["transport/link/tls"] = {
            "root_ca_certificate": str(tls.ca),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "connect_certificate": str(tls.certificate),
            "connect_private_key": str(tls.key),
            "listen_certificate": str(tls.certificate),
            "listen_private_key": str(tls.key),
        }
    if options.user is not None:
        settings["transport/auth/usrpwd/user"] = options.user
        settings["transport/auth/usrpwd/password"] = options.password
    if options.users is not None:
        settings["transport/auth/usrpwd/dictionary_file"] = str(options.users)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def first_line(error: BaseException) -> str:
    """Zenoh's error message, without the location in its source."""
    return str(error).partition(" at /")[0].strip()


_open: WeakSet[Connection] = WeakSet()
_opening = threading.Lock()
"""Held while `_open` changes or is listed: a set that changes while it is listed raises."""


def open_connections() -> list[Connection]:
    """The connections of this process that are not closed. Thread-safe."""
    with _opening:
        return [each for each in _open if not each.closed]


@cache
def _close_at_the_end() -> None:
    """Start a thread, once, that closes open sessions when the main thread ends, so that the process ends.

    Otherwise the interpreter waits for ever for Zenoh's callback threads, which wait for the end of their session. The
    thread is no daemon: killed while it closes a session, it would abort the process.
    """

    def close_all() -> None:
        threading.main_thread().join()
        for connection in open_connections():
            connection.close()

    threading.Thread(target=close_all, name="zenoh ends").start()


class Connection:
    """A Zenoh session. A peer or router opens it at once; a client keeps trying until the other side answers.

    After that, Zenoh itself reconnects and restores declarations.

    Raises:
        TransportError: e.g. if the address to listen on is in use, or a certificate cannot be read.
    """

    def __init__(self, options: ZenohOptions, log: logging.Logger) -> None:
        self._log = log
        set_malloc(_LARGEST_KEPT, _KEPT_BYTES)
        self.endpoints = ", ".join(options.connect or options.listen)
        """The addresses that it connects to, or listens on."""
        self._config = zenoh_config(options)
        self.knows_who_asks = restrict(self._config, options)
        """Whether the name in a request's key is verified."""
        self._lock = threading.Lock()
        self._session: zenoh.Session | None = None
        self._pending: dict[object, Callable[[zenoh.Session], Declared]] = {}
        self._declared: dict[object, Declared] = {}
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        with _opening:
            _open.add(self)
            _close_at_the_end()
        self._options = options
        self.why_not = f"nobody answers at {self.endpoints}"
        """Why there is no connection yet."""
        self.answered = threading.Event()
        """Set when the session is open."""
        if options.mode != "client":
            self.answered.set()
            try:
                self._session = zenoh.open(self._config)
            except zenoh.ZError as error:
                raise TransportError(f"{self.endpoints}: {first_line(error)}") from error
            return
        self._thread = threading.Thread(target=self._connect, name="zenoh connects", daemon=True)
        self._thread.start()
        self.answered.wait(_FIRST_WAIT_S)

    def session(self) -> zenoh.Session:
        """The session.

        Raises:
            TransportError: if closed, or not connected yet.
        """
        if (session := self.open_session) is None:
            raise TransportError(f"not connected: {self.why_not}")
        return session

    @property
    def open_session(self) -> zenoh.Session | None:
        """The session, or None before the other side has answered.

        Raises:
            TransportError: if closed.
        """
        self.check_open()
        return self._session

    @property
    def closed(self) -> bool:
        """Whether it is closed."""
        return self._closed.is_set()

    def check_open(self) -> None:
        """Check that the session is not closed.

        Raises:
            TransportError: if closed.
        """
        if self._closed.is_set():
            raise TransportError("the transport is closed")

    def declare(self, make: Callable[[zenoh.Session], Declared]) -> Callable[[], None]:
        """Call `make` to declare something on the session, now or when it is open; returns a function that ends it.

        Raises:
            TransportError: if closed.
        """
        key = object()
        with self._lock:
            if (session := self.open_session) is None:
                self._pending[key] = make
            else:
                self._declared[key] = make(session)

        def end() -> None:
            with self._lock:
                self._pending.pop(key, None)
                declared = self._declared.pop(key, None)
            if declared is not None and not self._closed.is_set():
                declared.undeclare()

        return end

    def close(self) -> None:
        """Close the session and all declarations."""
        with self._lock:
            if self._closed.is_set():
                return
            self._closed.set()
            session, self._session = self._session, None
            self._pending.clear()
            self._declared.clear()
        if self._thread is not None:
            self._thread.join(_CLOSE_WAIT_S)
        if session is not None:
            session.close()  # type: ignore[no-untyped-call]  # its stub has no types

    def _connect(self) -> None:
        """Try until a peer answers; log each new reason of failure once."""
        logged, asked_s = "", -math.inf
        pause_ms, longest_ms = _RETRY_MS
        while not self._closed.is_set():
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError:
                if time.monotonic() - asked_s > _ASK_WHY_S:
                    tried = {each: why_not(each, self._options.tls) for each in self._options.connect}
                    self.why_not = "; ".join(f"{endpoint}: {reason}" for endpoint, reason in tried.items())
                    asked_s = time.monotonic()
                if self.why_not != logged:
                    self._log.warning("not connected yet: %s", logged := self.why_not)
                self._closed.wait(pause_ms / 1000)
                pause_ms = min(2 * pause_ms, longest_ms)
                continue
            with self._lock:
                if not self._closed.is_set():
                    self._session = session
                    self._declared |= {key: make(session) for key, make in self._pending.items()}
                    self._pending.clear()
                    self.answered.set()
                    if logged:
                        self._log.info("connected to %s", self.endpoints)
                    return
            session.close()  # type: ignore[no-untyped-call]  # its stub has no types
