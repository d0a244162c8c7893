"""All hardware of a robot as one object: several components with their own joints, read and written in parallel."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, wait
from functools import partial
from typing import Any

import numpy as np

from ibrobot_core.errors import HardwareError, IbrobotError, NotSupported
from ibrobot_core.interfaces.hardware import (
    Condition,
    EpisodeSetup,
    Hardware,
    Holding,
    JointReading,
    Signal,
    SimulatedHardware,
    Torque,
)
from ibrobot_core.robot import Robot, Vector

_RELAX_S = 1.0
"""How long switching the torque of a part off may take, if there are several [s]."""
_LOG = logging.getLogger("ibrobot.control")


class HardwareGroup:
    """All hardware of a robot, with joints in robot order.

    Args:
        robot: the joints.
        parts: name -> hardware; each joint belongs to exactly one part.
        timeout_s: how long a tick waits for a part to read or write, if there are several [s]. Until a part that hangs
            returns, all calls fail for it, and the others go on.
    """

    def __init__(self, robot: Robot, parts: dict[str, Hardware], timeout_s: float = 0.1) -> None:
        self._parts = parts
        self._timeout_s = timeout_s
        self._simulated = [part for part in parts.values() if isinstance(part, SimulatedHardware)]
        self._indices = {name: robot.indices(part.joints) for name, part in parts.items()}
        self._size = len(robot.joints)
        self._off: set[str] = set()
        self._threads = {name: _PartThread(name) for name in parts} if len(parts) > 1 else {}
        self.signals: tuple[Signal, ...] = tuple(s for part in parts.values() for s in part.signals)
        self._signal_values: Vector = np.full(sum(s.size for s in self.signals), np.nan)
        # A single part with all joints in order needs no copying in the tick.
        only = next(iter(parts.values()))
        self._single = only if len(parts) == 1 and only.joints == robot.joint_names else None

    def connect(self) -> None:
        """Connect all parts; if one fails, restore the parts connected before it."""
        connected: list[str] = []
        try:
            for name, part in self._parts.items():
                _named(name, part.connect)
                connected.append(name)
        except IbrobotError:
            self.undo_connect(connected)
            self.disconnect()
            raise

    def undo_connect(self, names: Collection[str] | None = None) -> None:
        """Switch off the torque that `connect` switched on, for all parts or `names`; log what stays on."""
        for name, part in self._parts.items():
            if names is None or name in names:
                try:
                    part.undo_connect()
                except HardwareError as error:
                    _LOG.error("torque of %s cannot be taken off: %s", name, error)

    def holding(self) -> list[Holding]:
        """The parts known to hold torque."""
        return [holding for part in self._parts.values() if (holding := part.holding()) is not None]

    def health(self) -> Sequence[Condition]:
        """The conditions of the joints of all parts."""
        if self._single is not None:
            return self._single.health()
        return [condition for name, part in self._parts.items() if not self._hangs(name) for condition in part.health()]

    def disconnect(self) -> None:
        """Release all, except parts that hang."""
        for name, part in self._parts.items():
            if self._hangs(name):
                _LOG.error("%s hangs, and is not released", name)
            else:
                part.disconnect()
        for thread in self._threads.values():
            thread.end()

    def read(self) -> JointReading:
        """Measure every joint; the stamp is the oldest of all parts.

        Raises:
            HardwareError: if a part fails; names the part.
        """
        if self._single is not None:
            return self._single.read()
        readings: list[JointReading] = list(self._each(lambda part: part.read(), timeout_s=self._timeout_s))
        position, velocity, effort = np.empty(self._size), np.empty(self._size), np.empty(self._size)
        for index, reading in zip(self._indices.values(), readings, strict=True):
            position[index], velocity[index], effort[index] = reading.position, reading.velocity, reading.effort
        stamp_ns = min(reading.stamp_ns for reading in readings)
        return JointReading(stamp_ns, position, velocity, effort, any(reading.stale for reading in readings))

    def write(self, command: Vector) -> None:
        """Command every joint [rad], shape (J,).

        Raises:
            HardwareError: if a part fails; names the part.
        """
        if self._single is not None and not self._off:
            self._single.write(command)
            return
        commands = {id(part): command[self._indices[name]] for name, part in self._parts.items()}
        self._each(lambda part: part.write(commands[id(part)]), but=self._off, timeout_s=self._timeout_s)

    def relax(self) -> dict[str, Torque | IbrobotError]:
        """Switch torque off; return for each part the result, or the error that kept its torque on.

        Until `resume`, only parts whose torque stays on are written.
        """
        outcomes: dict[str, Torque | IbrobotError] = {}
        for name, outcome in self._outcomes(lambda part: part.relax(), self._parts, _RELAX_S).items():
            error = outcome.exception()
            outcomes[name] = error if isinstance(error, IbrobotError) else outcome.result()
        self._off = {name for name, outcome in outcomes.items() if isinstance(outcome, Torque)}
        return outcomes

    def resume(self) -> None:
        """Write all parts again; the next `write` switches torque back on."""
        self._off.clear()

    @property
    def holds(self) -> bool:
        """Whether any part is still written, so that its joints hold their position."""
        return len(self._off) < len(self._parts)

    def require_relax(self) -> None:
        """Check that every part can switch torque off.

        Raises:
            NotSupported: if a part cannot; names the part.
        """
        for name, part in self._parts.items():
            if type(part).relax is Hardware.relax:
                raise NotSupported(f"control.stop: relax: hardware {name!r} cannot take torque off; use hold or a pose")

    def reset_faults(self) -> None:
        """Clear the latched faults of all parts."""
        self._each(lambda part: part.reset_faults())

    def counters(self) -> dict[str, dict[str, int]]:
        """The counters of each part; parts without counters are omitted."""
        answering = {name: part for name, part in self._parts.items() if not self._hangs(name)}
        return {name: counts for name, part in answering.items() if (counts := dict(part.counters()))}

    def read_signals(self) -> Vector:
        """The concatenated signals of all parts, shape (S,); the next call reuses the array."""
        begin = 0
        for name, part in self._parts.items():
            hangs = self._hangs(name)
            for index, signal in enumerate(part.signals):
                values = self._signal_values[begin : begin + signal.size]
                if hangs:
                    values[:] = np.nan
                else:
                    part.read_signal(index, values)
                begin += signal.size
        return self._signal_values

    def advance(self, step_ns: int) -> None:
        """Advance the simulated parts."""
        for part in self._simulated:
            part.advance(step_ns)

    def reset_episode(self, episode: EpisodeSetup) -> None:
        """Reset the simulated scenes.

        Raises:
            NotSupported: if no part is simulated.
        """
        if not self._simulated:
            raise NotSupported("only a simulation can be set up again")
        for part in self._simulated:
            part.reset(episode)

    @property
    def factors(self) -> dict[str, float]:
        """What the present episode of the simulated parts has drawn."""
        return {name: value for part in self._simulated for name, value in part.factors.items()}

    def success(self) -> bool | None:
        """Whether the scene's task is done; None if it has no task."""
        return self._simulated[0].success() if self._simulated else None

    def _hangs(self, name: str) -> bool:
        return name in self._threads and self._threads[name].hangs

    def _each(
        self, act: Callable[[Hardware], Any], but: Collection[str] = (), timeout_s: float | None = None
    ) -> Sequence[Any]:
        parts = {name: part for name, part in self._parts.items() if name not in but}
        return [_named(name, each.result) for name, each in self._outcomes(act, parts, timeout_s).items()]

    def _outcomes(
        self, act: Callable[[Hardware], Any], parts: Mapping[str, Hardware], timeout_s: float | None
    ) -> dict[str, Future[Any]]:
        """The outcome of `act` for each part: of all, even if one fails or is not done within `timeout_s` [s]."""
        if not self._threads:
            return {name: _done(partial(act, part)) for name, part in parts.items()}
        begun = {name: self._threads[name].begin(partial(act, part)) for name, part in parts.items()}
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        return {name: self._threads[name].outcome(each, deadline_s) for name, each in begun.items()}


class _PartThread:
    """The thread of one part. It is a daemon, so that a part that hangs does not keep the process from ending."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._late: Future[Any] | None = None

    @property
    def hangs(self) -> bool:
        """Whether a call has not returned in time, and still has not."""
        return self._late is not None and not self._late.done()

    def begin(self, act: Callable[[], Any]) -> Future[Any]:
        """Begin a call; its outcome is an error if an earlier one hangs."""
        called: Future[Any] = Future()
        if self.hangs:
            called.set_exception(HardwareError(f"{self._name}: still does not return from an earlier call"))
            return called
        if self._thread is None:
            self._thread = threading.Thread(target=self._call_all, name=f"part {self._name}", daemon=True)
            self._thread.start()
        self._calls.put((act, called))
        return called

    def outcome(self, called: Future[Any], deadline_s: float | None) -> Future[Any]:
        """The outcome of a call, or an error if it has none by a time (`time.monotonic`) [s]."""
        timeout_s = None if deadline_s is None else max(0.0, deadline_s - time.monotonic())
        if wait([called], timeout_s).done:
            return called
        self._late = called
        failed: Future[Any] = Future()
        failed.set_exception(HardwareError(f"{self._name}: hangs: it has not returned in time"))
        return failed

    def end(self) -> None:
        """End the thread; one that hangs is left alone."""
        if self._thread is not None:
            self._calls.put(None)
            if not self.hangs:
                self._thread.join()
            self._thread = None

    def _call_all(self) -> None:
        while (call := self._calls.get()) is not None:
            _settle(*call)


def _done(act: Callable[[], Any]) -> Future[Any]:
    called: Future[Any] = Future()
    _settle(act, called)
    return called


def _settle(act: Callable[[], Any], called: Future[Any]) -> None:
    try:
        called.set_result(act())
    except BaseException as error:  # noqa: BLE001 - raised where the result is needed
        called.set_exception(error)


def _named(name: str, act: Callable[[], Any]) -> Any:
    try:
        return act()
    except HardwareError as error:
        text = str(error)
        raise HardwareError(text if name in text else f"{name}: {text}") from error
