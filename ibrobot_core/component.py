"""Components: the parts of a run, which start, become ready, work and stop, in a thread or in lockstep."""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from contextlib import ExitStack, suppress
from typing import override

from ibrobot_core.bug_reports import as_failure
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.errors import ComponentFailed
from ibrobot_core.interfaces import Transport
from ibrobot_core.interfaces.run import CommandSource, RunView
from ibrobot_core.schema import ControlMode

CONTROL = "control"
"""Name of the component that owns the hardware; components that need joint states list it in `needs`."""
TRANSPORT = "transport"
"""Name of the component that opens the transport."""
_POLL_S = 0.1
"""Longest wait of a unit of work, so that a worker notices a stop [s]."""
_STOP_TIMEOUT_S = 5.0
"""Time that a unit of work may continue after a stop [s]."""


class Component(ABC):
    """One part of a run.

    Attributes:
        name: unique within the run, e.g. `sensor:top`.
        needs: names of the components that must be ready before this one starts.
        summary: one line for `--dry-run`.
        sends_stops: whether an operator can send an emergency stop by it; at the end of the run it stops only after
            the robot.
        may_wait: whether its `stop` may take long, e.g. for a slow disk; it, too, stops only after the robot.
    """

    sends_stops = may_wait = False

    def __init__(self, name: str, summary: str, needs: tuple[str, ...] = ()) -> None:
        self.name = name
        self.summary = summary
        self.needs = needs

    @abstractmethod
    def start(self) -> None:
        """Start, and return when ready.

        Raises:
            IbrobotError: if it cannot start.
        """

    @abstractmethod
    def stop(self) -> None:
        """Stop. Safe to call twice, and after a failed `start`."""

    def step(self, now_ns: int) -> None:
        """Lockstep: do the work due at `now_ns` [ns]."""


class SessionWorker(Component):
    """Repeats a unit of work, in its own thread, or once per tick in lockstep; its failure ends the run.

    Args:
        session: the run; also an attribute.
        name: unique within the run.
        summary: one line for `--dry-run`.
        needs: names of the components that must be ready before this one starts, e.g. `CONTROL`.

    Attributes:
        urgent: whether its thread calls `raise_thread_priority`: only for a class whose units of work are short.
        ready_timeout_s: time for which `start` waits until the worker is ready [s].
    """

    urgent = False
    ready_timeout_s = 60.0
    session: RunView
    """A subclass that does more to the run says so: `session: StreamingRun`."""

    def __init__(self, session: RunView, name: str, summary: str, needs: tuple[str, ...] = ()) -> None:
        super().__init__(name, summary, needs)
        self.session = session
        self._thread: threading.Thread | None = None
        self._set_up = False
        self._end = threading.Event()
        self._ready = threading.Event()
        self._failure: Exception | None = None
        self.on_end = ExitStack()
        """Cleanups registered by `setup`, e.g. `on_end.callback(device.close)`, run in reverse order."""

    def setup(self) -> None:
        """Create and open the resources that `work` needs."""

    @abstractmethod
    def work(self, timeout_s: float) -> None:
        """Do one unit of work; wait for it at most `timeout_s` [s]."""

    def teardown(self) -> None:
        """Close the resources opened by `setup`, even if it failed. By default, run the callbacks of `on_end`."""
        self.on_end.close()

    def pause(self, timeout_s: float) -> None:
        """Wait `timeout_s` [s], or until a stop."""
        self._end.wait(timeout_s)

    def is_ready(self) -> bool:
        """Whether dependent components may start; called after `setup` and each unit of work."""
        return True

    def not_ready(self) -> str:
        """Why the worker is not ready, for the error after `ready_timeout_s`."""
        return "not ready"

    @override
    def start(self) -> None:
        if self.session.request.lockstep:
            self._set_up = True
            self.setup()
            return
        self._end.clear()
        self._ready.clear()
        self._failure = None
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()
        deadline = time.monotonic() + self.ready_timeout_s
        while not self._ready.wait(min(_POLL_S, self.ready_timeout_s)):
            if self.session.finished.is_set():
                raise ComponentFailed(f"{self.not_ready()} when the run ended")
            if time.monotonic() >= deadline:
                raise ComponentFailed(f"{self.not_ready()} after {self.ready_timeout_s:g} s")
        if self._failure is not None:
            raise self._failure

    @override
    def step(self, now_ns: int) -> None:
        self.work(0.0)

    @override
    def stop(self) -> None:
        self._end.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_STOP_TIMEOUT_S)
            if self._thread.is_alive():
                raise ComponentFailed(f"{self.name} hangs: still working {_STOP_TIMEOUT_S:g} s after the stop")
            self._thread = None
        if self._set_up:
            self._set_up = False
            self.teardown()

    def _run(self) -> None:
        if self.urgent:
            raise_thread_priority()
        try:
            try:
                self.setup()
                while not self._end.is_set():
                    if not self._ready.is_set() and self.is_ready():
                        self._ready.set()
                    self.work(_POLL_S)
            finally:
                self.teardown()
        except BaseException as error:  # noqa: BLE001 - reported to the run, which ends with it as the cause
            was_ready = self._ready.is_set()
            self._failure = as_failure(error)
            self._ready.set()
            if was_ready:
                self.session.fail(self.name, self._failure)


class SourceWorker(SessionWorker, CommandSource):
    """A command source for one mode, with its own thread or, in lockstep, its own step.

    `setup` runs once, then `work` repeatedly, and `teardown` at the end. `begin_mode` and `end_mode` run between two
    units of work. A source sends setpoints with `session.send_plan`. `session.finish` ends the run, and so does an
    exception.

    Args:
        session: the run.
        mode: the mode whose executors it commands.
        summary: one line for `--dry-run`.
        needs: names of the components that must be ready before it starts.

    Attributes:
        mode: the mode.
        active: whether the mode is entered; `work` must not send commands otherwise.
        lock: held during `begin_mode` and `end_mode`. Hold it while `work` checks `active` and sends commands.
    """

    def __init__(self, session: RunView, mode: ControlMode, summary: str, needs: tuple[str, ...] = (CONTROL,)) -> None:
        super().__init__(session, f"mode:{mode.name}", summary, needs)
        self.mode = mode
        self.active = False
        self.lock = threading.RLock()

    @override
    def begin(self, seed: int) -> None:
        with self.lock:
            self.end()
            self.begin_mode(seed)
            self.active = True

    @override
    def end(self) -> None:
        with self.lock:
            if self.active:
                self.active = False
                self.end_mode()

    @abstractmethod
    def begin_mode(self, seed: int) -> None:
        """Start from the measured state; called with the lock held."""

    def end_mode(self) -> None:
        """Stop; called with the lock held."""


class TransportLink(Component):
    """Opens the transport named in the YAML, for components that communicate with other machines."""

    def __init__(self, session: RunView, section: ComponentConfig) -> None:
        super().__init__(TRANSPORT, f"transport {section.type}")
        self._session = session
        self._section = section
        self._transport: Transport | None = None

    @property
    def transport(self) -> Transport:
        """The transport.

        Raises:
            ComponentFailed: before it is open.
        """
        if self._transport is None:
            raise ComponentFailed("the transport is not open yet")
        return self._transport

    @override
    def start(self) -> None:
        self._transport = self._session.make("transport", self._section, TRANSPORT)

    @override
    def stop(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None


def raise_thread_priority() -> None:
    """Give the calling thread the lowest real-time priority (SCHED_RR), if the machine permits it.

    The thread then takes precedence over ordinary programs, but not over the control loop. Threads and processes that
    it starts have the ordinary priority. Use it for threads that work for a bounded time and then wait. Refusals are
    not reported here, but by the control loop.
    """
    with suppress(AttributeError, OSError):
        lowest = os.sched_get_priority_min(os.SCHED_RR)
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(lowest))
