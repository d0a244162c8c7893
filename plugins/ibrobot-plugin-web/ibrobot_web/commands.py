"""Commands of pages, received and carried out in the host: each is a service of the run or its emergency stop."""

from __future__ import annotations

import logging
import queue
import select
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import attrs

from ibrobot_core.api import IbrobotError, PlanningError, seconds
from ibrobot_core.app import (
    Child,
    Pulse,
    RunView,
    error_text,
    raise_thread_priority,
)
from ibrobot_web import messages
from ibrobot_web.messages import Pages, Release, RunCommand, Sent, StopRun, clock_ns, from_server
from ibrobot_web.teleop import JOG, RELEASE, Jog, Released

Reply = Callable[[Mapping[str, Any]], None]
Handler = Callable[[RunView, Any], Any]
_LATE_MS = 200
"""Age from which on messages of the deadman are refused [ms]."""
_AHEAD_MS = 5
"""How far a page's estimate of the time may be ahead [ms]."""
_ALWAYS = messages.Finish | messages.Reset | messages.Preview | messages.Abandoned
"""Commands that may be older than an emergency stop: a reset says which stops it clears, the others move nothing."""
_STOPPED = "an emergency stop came after this command was sent, so it is not carried out; reset, then send it again"
_PLAN = "/planning/plan"
_PREVIEW_ROWS = 40
_RECORD = "/record_episode"
_BEGINS = (f"{_RECORD}/start", f"{_RECORD}/redo")
_BLOCKED_S = 6.0
"""Time without a sign of life of a thread that stops go through after which the run ends [s]; control may take 5 s to
answer."""
_POLL_S = 0.1
_TRIAL = -1
"""The number of a stop that is only tried out."""
_NS_PER_MS = 1_000_000
_MOTION = tuple(attrs.fields_dict(messages.Motion))
_log = logging.getLogger("ibrobot.web")


class Commands:
    """Carries out commands, in order, in a thread; the emergency stop has its own, and waits for no other command.

    An emergency stop empties the queue of the others. Its thread tries one out at the start, and gives signs of life.

    Args:
        session: the run.
        finish: ends the run.
        reply: sends the reply to a command.
        on_failure: called with the error that ended a thread, whose commands are no longer heard.
    """

    def __init__(
        self, session: RunView, finish: Callable[[], None], reply: Reply, on_failure: Callable[[Exception], None]
    ) -> None:
        self._session = session
        self._finish = finish
        self._reply = reply
        self._on_failure = on_failure
        self._begun = 0
        """Number of the last episode that a page began; 0 before the first."""
        self._stops: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._others: queue.SimpleQueue[Sent[RunCommand] | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._guarded, args=(work,), name=f"web {name}", daemon=True)
            for name, work in (("stop", self._work_on_stops), ("other", self._work_on_others))
        ]
        self._pulse = Pulse("STOP of the page", _BLOCKED_S)
        for thread in self._threads:
            thread.start()
        session.pulses.add(self._pulse)
        self._stops.put(_TRIAL)

    def stop(self, number: int) -> None:
        """Stop the robot, and refuse the commands that wait."""
        for sent in _waiting(self._others):
            self._refuse(sent, _STOPPED)
        self._stops.put(number)

    def take(self, sent: Sent[RunCommand]) -> None:
        """Carry out a command, now or as soon as its turn comes."""
        if isinstance(sent.command, messages.Jog | messages.Release):  # which only leave a note for the teleop
            self._carry_out(sent)
        else:
            self._others.put(sent)

    def close(self, timeout_s: float) -> None:
        """End the threads; a command that is being carried out is given `timeout_s` [s]."""
        self._session.pulses.discard(self._pulse)
        self._stops.put(None)
        self._others.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout_s)

    def _guarded(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # noqa: BLE001 - reported to the run, which ends: this thread hears nothing more
            self._on_failure(error)

    def _work_on_stops(self) -> None:
        """Stop the robot once for all stops that wait."""
        raise_thread_priority()
        while True:
            self._pulse.beat()
            try:
                numbers = [self._stops.get(timeout=Pulse.period_s), *_waiting(self._stops)]
            except queue.Empty:
                continue
            if stops := [number for number in numbers if number not in (None, _TRIAL)]:
                reply = self._outcome_of(self._session.emergency_stop)
                for number in stops:
                    self._reply({"reply": number, **reply})
            elif _TRIAL in numbers:
                self._session.check_stop()
            if None in numbers:
                return

    def _work_on_others(self) -> None:
        while (sent := self._others.get()) is not None:
            self._carry_out(sent)

    def _carry_out(self, sent: Sent[RunCommand]) -> None:
        if self._is_older_than_a_stop(sent):
            self._refuse(sent, _STOPPED)
            return
        reply = self._outcome_of(partial(self._execute, sent))
        if sent.number is not None:
            self._reply({"reply": sent.number, **reply})

    def _is_older_than_a_stop(self, sent: Sent[RunCommand]) -> bool:
        if isinstance(sent.command, messages.Jog | messages.Release | _ALWAYS):
            return False
        return sent.stops is None or sent.stops < self._session.stops

    def _refuse(self, sent: Sent[RunCommand] | None, why: str) -> None:
        if sent is not None and sent.number is not None:
            self._reply({"reply": sent.number, "error": why})

    def _outcome_of(self, execute: Callable[[], Any]) -> dict[str, Any]:
        try:
            value = execute()
            return {"ok": value if isinstance(value, str | int | float | bool | Mapping) else None}
        except (IbrobotError, ValueError, TypeError) as error:
            return {"error": str(error) or type(error).__name__}
        except Exception as error:  # noqa: BLE001 - contained: a page must not end the run
            _log.exception("a command of the page failed")
            return {"error": error_text(error)}

    def _execute(self, sent: Sent[RunCommand]) -> Any:
        match sent.command:
            case messages.Finish():
                return self._finish()
            case messages.Abandoned():
                return self._abandon()
            case messages.Call(service, request):
                answer = self._session.bus.call(service, request)
                if service in _BEGINS and self._session.bus.serves(f"{_RECORD}/status"):
                    status = self._session.bus.call(f"{_RECORD}/status")
                    self._begun = status.episode + status.waiting
                return answer
        return _HANDLERS[type(sent.command)](self._session, sent)

    def _abandon(self) -> None:
        """End the episode that a page began, if it goes on: nobody does, and an idle arm would be recorded."""
        if not self._begun:
            return
        bus = self._session.bus
        status = bus.call(f"{_RECORD}/status")
        if status.episode + status.waiting != self._begun or not (status.recording or status.waiting):
            return
        ends = ("discard", None) if status.waiting else ("stop", "unknown")
        bus.call(f"{_RECORD}/{ends[0]}", ends[1])
        _log.warning("the page was closed or loaded again, and nobody went on: its episode has ended, not judged")


class Receiver:
    """Takes the messages of the page's server, in a thread without which the page's STOP would be deaf.

    Args:
        child: the server's process.
        session: the run.
        commands: carries out commands.
        on_pages: called when pages come or go, or show other channels.
        on_failure: called with the error that ended the thread.

    Attributes:
        open: set to False to end the thread, as the end of the server does.
        alive_s: when the server last gave a sign of life, by the monotonic clock [s].
        death: why the server is dead; empty while it lives.
    """

    def __init__(
        self, child: Child, session: RunView, commands: Commands, on_pages: Callable[[Pages], None],
        on_failure: Callable[[Exception], None],
    ) -> None:  # fmt: skip
        self._child = child
        self._session = session
        self._commands = commands
        self._on_pages = on_pages
        self._on_failure = on_failure
        self.open = True
        self.alive_s = time.monotonic()
        self.death = ""
        self._thread = threading.Thread(target=self._receive, name="web commands", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Wait for the end of the thread."""
        self._thread.join()

    def _receive(self) -> None:
        raise_thread_priority()
        pulse = Pulse("commands of the page", _BLOCKED_S)
        self._session.pulses.add(pulse)
        died = False
        try:
            while not self._child.channel.closed and self.open:
                pulse.beat()
                self._take()
            died = self.open
        except Exception as error:  # noqa: BLE001 - reported to the run, which ends
            self._on_failure(error)
        self._session.pulses.discard(pulse)
        if self.open:
            self._commands.take(Sent(None, None, Release()))
        if died:
            self.death = f"the page's server died: {self._child.cause()}"

    def _take(self) -> None:
        """Wait for messages of the server, and take them."""
        try:
            if not select.select([self._child.channel.fileno()], [], [], _POLL_S)[0]:
                return
            arrived = self._child.receive()
        except (OSError, ValueError):  # closed meanwhile
            return
        self.alive_s = time.monotonic()
        for each in arrived:
            try:
                message = from_server(each)
            except (ValueError, IbrobotError) as error:
                _log.warning("dropped a message: %s", error)
                continue
            match message:
                case Pages():
                    self._on_pages(message)
                case StopRun(number):
                    self._commands.stop(number)
                case Sent():
                    self._commands.take(message)


def _waiting[T](waiting: queue.SimpleQueue[T]) -> list[T]:
    """All items of a queue."""
    commands = []
    while True:
        try:
            commands.append(waiting.get_nowait())
        except queue.Empty:
            return commands


def _jog(session: RunView, sent: Sent[messages.Jog]) -> None:
    if not session.bus.serves(JOG):
        raise IbrobotError("this mode does not jog from the page: enter a mode whose teleop is of type web")
    jog, now_ms = sent.command, clock_ns() / _NS_PER_MS
    # A press in the future would be new at each message: one held over a stop and its reset would move the robot.
    if jog.at > now_ms + _AHEAD_MS or jog.press > jog.at + _AHEAD_MS:
        raise IbrobotError("the page's time is wrong; press again")
    if now_ms - jog.at > _LATE_MS:
        raise IbrobotError(f"the connection is too slow to jog ({(now_ms - jog.at) / 1e3:.1f} s)")
    made_ns, began_ns = _run_times(session, jog.at, jog.press)
    session.bus.call(JOG, Jog(made_ns, began_ns, **{name: getattr(jog, name) for name in _MOTION}))


def _release(session: RunView, sent: Sent[messages.Release]) -> None:
    if session.bus.serves(RELEASE):
        at = sent.command.at
        session.bus.call(RELEASE, Released(None if at is None else _run_times(session, at)[0]))


def _run_times(session: RunView, *times_ms: int) -> list[int]:
    """Times of `clock_ms` by the run's clock [ns], in the same order; the present for later ones."""
    now_ns, page_ns = session.clock.now_ns(), clock_ns()
    return [now_ns - max(0, page_ns - time_ms * _NS_PER_MS) for time_ms in times_ms]


def _reset(session: RunView, sent: Sent[messages.Reset]) -> Any:
    if sent.stops is None:
        raise IbrobotError("this page has seen no state of the robot yet")
    return session.bus.call("/reset", {"stops": sent.stops})


def _preview(session: RunView, sent: Sent[messages.Preview]) -> Mapping[str, Any]:
    """The path to a goal, planned and not executed: joints by index, and rows of positions [rad]."""
    answer = session.bus.call(_PLAN, {"goal": sent.command.goal})
    if answer.trajectory is None:
        raise PlanningError(answer.message)
    points = answer.trajectory.points
    chosen = points[:: max(1, len(points) // _PREVIEW_ROWS)] + points[-1:]
    return {
        "joints": [int(i) for i in session.config.robot.indices(answer.trajectory.joint_names)],
        "rows": [[round(float(value), 4) for value in point.positions] for point in chosen],
        "duration_s": round(seconds(points[-1].time_from_start_ns), 2),
    }


_HANDLERS: Mapping[type[RunCommand], Handler] = {
    messages.Jog: _jog,
    messages.Release: _release,
    messages.Reset: _reset,
    messages.Preview: _preview,
}
