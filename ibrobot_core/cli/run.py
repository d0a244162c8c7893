"""Runs of a robot from the command line: panel or plain lines, keys, signals, summary and exit status."""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress

import attrs

from ibrobot_core.cli.panel import RecentLog, RecentRates, panel, plain_line
from ibrobot_core.config import RobotConfig
from ibrobot_core.errors import IbrobotError, RequestError, TeleopError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.keys import RELEASE, REPEAT
from ibrobot_core.launch.models import check_models
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.output_thread import discard, output_aside
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.pulses import PULSE_S, Pulse
from ibrobot_core.run_hooks import RunHooks
from ibrobot_core.safe_output import LogFormatter, echo
from ibrobot_core.signals import end_signals
from ibrobot_core.terminal import KeyReader

NOT_ALL_SUCCEEDED = 3
_FAULTED = 1
_INTERRUPTED_TWICE = 130
_PANEL_HZ = 8
_PLAIN_PERIOD_S = 2.0
_READER_S = 1.0
"""Wait for a stalled stdout reader after a signal [s]."""
_KEYS_BLOCKED_S = 2.0
_STOP_BLOCKED_S = 6.0
"""Times without a sign of life of the threads that read and handle keys, after which the run ends [s]. The answer of
control to the emergency stop may take 5 s."""


def run_robot(
    config: RobotConfig, request: LaunchRequest, *, headless: bool = False, dry_run: bool = False,
    as_json: bool = False, make_hooks: Callable[[Runtime], RunHooks] = lambda runtime: RunHooks(),
) -> None:  # fmt: skip
    """Run a robot as `ibrobot launch` does, print the summary and exit.

    Args:
        config: the robot.
        request: the user's request.
        headless: whether to print plain lines, without window, viewer and panel.
        dry_run: whether to only print the plan and compare models with the contract.
        as_json: whether to print only JSON on standard output.
        make_hooks: creates the hooks of the command, before the run starts.

    Raises:
        IbrobotError: e.g. if a component fails.
        SystemExit: at the end of a run without failed components; docs/reference/exit-codes.md lists the codes.
    """
    if request.lockstep and not config.simulated:
        raise RequestError("--lockstep is for simulation: add --sim")
    if headless and config.viewer is not None:
        config = attrs.evolve(config, viewer=None)
    with ExitStack() as stack:
        keys = KeyReader() if sys.stdin.isatty() and not (headless or dry_run) else None
        if keys is not None:
            request = attrs.evolve(request, keys=keys.subscribe)
        runtime = Runtime(Session(config, installed_plugins(), request))
        if dry_run:
            models = check_models(config, installed_plugins(), [runtime.session.mode])
            plan = runtime.plan
            echo(json.dumps({**plan.facts(), "models": models}) if as_json else "\n".join([*plan.lines(), *models]))
            return
        hooks = make_hooks(runtime)
        signals = _Signals(runtime.session, keys)
        stack.enter_context(output_aside(lambda: _READER_S if signals.came else None))
        stack.enter_context(signals)
        if keys is not None:  # only now, since until here Ctrl-C ends the process without restoring the terminal
            _watch_keys(runtime.session, keys)
            stack.enter_context(keys)
        try:
            status = _run(runtime, hooks, signals, live=not headless, as_json=as_json)
        finally:
            for line in runtime.session.outcome.holding:
                echo(line, err=True)
    _print_summary(runtime, hooks, as_json)
    runtime.raise_failure()
    sys.exit(status)


def _run(runtime: Runtime, hooks: RunHooks, signals: _Signals, *, live: bool, as_json: bool) -> int:
    """Start, run and stop; return the exit status of a run without failures.

    Status goes to standard output, or to standard error with `as_json`.

    Raises:
        KeyboardInterrupt: if a signal came before the run began.
    """
    session = runtime.session
    where = "simulation" if session.config.simulated else "hardware"
    with ExitStack() as stack:
        panel_fits = live and (sys.stderr if as_json else sys.stdout).isatty()
        display = (_Panel if panel_fits else _Lines)(runtime, hooks, stack, err=as_json)
        config = session.config
        session.log.info("%s from %s: %s, mode %s", config.robot.name, config.source, where, session.mode)
        runtime.start(display.starting)
        stack.callback(runtime.stop)
        if signals.came:
            raise KeyboardInterrupt
        while not (runtime.step() if session.request.lockstep else runtime.wait(1.0 / _PANEL_HZ)):
            hooks.step()
            display.show()
    outcome = session.outcome
    if session.faults:
        return _FAULTED
    return NOT_ALL_SUCCEEDED if outcome.successes < outcome.episodes or outcome.goals_failed else 0


def _watch_keys(session: Session, keys: KeyReader) -> None:
    """End the run when the terminal's keys, including the emergency stop, are no longer read."""
    pulse = Pulse("keys of the terminal", _KEYS_BLOCKED_S)
    session.pulses.add(pulse)
    keys.beat = pulse.beat

    def gone() -> None:
        session.pulses.discard(pulse)
        session.fail(pulse.name, TeleopError("the terminal is gone: its keys stop the robot no more"))

    keys.gone = gone


class _Signals:
    """Stops the run at the first of the `end_signals`; a second SIGTERM brakes the robot on its way to a stop pose.

    A second Ctrl-C ends the host, and control brakes the robot. At Ctrl-Z, the robot holds before the host is
    suspended. A thread acts on the signals, since the main thread may be blocked.

    Attributes:
        came: whether a signal ended the run.
    """

    def __init__(self, session: Session, keys: KeyReader | None) -> None:
        self._session = session
        self._keys = keys
        self._terminals = [fd for fd in (1, 2) if os.isatty(fd)]
        self.came = False

    def __enter__(self) -> None:
        suspend = [signal.SIGTSTP] if signal.getsignal(signal.SIGTSTP) is signal.SIG_DFL else []
        numbers = (*end_signals(), *suspend)
        self._read, self._write = os.pipe()
        os.set_blocking(self._write, False)
        self._before = {number: signal.signal(number, lambda *_: None) for number in numbers}
        self._wakeup = signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._act_on_all, name="signals", daemon=True)
        self._thread.start()

    def __exit__(self, *raised: object) -> None:
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        os.close(self._write)
        self._thread.join()
        os.close(self._read)

    def _act_on_all(self) -> None:
        while received := os.read(self._read, 64):
            for number in received:
                if number == signal.SIGTSTP:
                    self._suspend()
                elif number in self._before:
                    self._stop(number)

    def _stop(self, number: int) -> None:
        session = self._session
        if self.came and number == signal.SIGINT:
            if self._keys is not None:
                self._keys.close()
            os._exit(_INTERRUPTED_TWICE)
        if number == signal.SIGHUP:  # the terminal may be closed; writing to it must not fail
            discard(self._terminals)
        if session.finished.is_set() and number == signal.SIGTERM:
            _try(session, session.emergency_stop)
            return
        self.came = True
        session.finish()
        session.log.info("stopping; Ctrl-C again stops at once")

    def _suspend(self) -> None:
        session = self._session
        if session.has_control and not session.request.lockstep:
            with suppress(IbrobotError):
                session.raise_fault("the host was suspended by Ctrl-Z")
            time.sleep(session.config.control.peer_timeout)  # until the robot has stopped
        with self._keys.suspended() if self._keys is not None else nullcontext():
            os.kill(os.getpid(), signal.SIGSTOP)


def _listen(session: Session, take: Callable[[tuple[str, int]], None]) -> None:
    """Stop the robot at Esc, in every mode and view; `take` gets other keys with the number of emergency stops.

    A thread does it, so that the emergency stop does not wait, e.g. for a mode that loads.
    """
    if session.request.keys is None:
        return
    keys = session.request.keys()
    pulse = Pulse("emergency stop by Esc", _STOP_BLOCKED_S)
    session.pulses.add(pulse)

    def work() -> None:
        while True:
            pulse.beat()
            with suppress(queue.Empty):
                key = keys.get(timeout=PULSE_S)
                if key.startswith((REPEAT, RELEASE)):
                    continue
                if key == "esc":
                    _try(session, session.emergency_stop)
                else:
                    take((key, session.stops))

    threading.Thread(target=work, name="runtime keys", daemon=True).start()


class _Lines:
    """Plain status lines, for output without a terminal."""

    def __init__(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> None:
        self._session = runtime.session
        self._hooks = hooks
        self._err = err
        self._rates = RecentRates()
        self._next_s = time.monotonic() + _PLAIN_PERIOD_S
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(LogFormatter("%(levelname).1s %(message)s"))
        _log_to(handler)
        _listen(runtime.session, lambda pressed: None)

    def starting(self, component: str) -> None:
        """Print nothing for components that start."""

    def show(self) -> None:
        """Print a status line at intervals."""
        self._rates.sample(self._session)
        if time.monotonic() >= self._next_s:
            self._next_s += _PLAIN_PERIOD_S
            line = plain_line(self._session, self._rates)
            echo(f"{line} | {more}" if (more := self._hooks.line()) else line, err=self._err)


class _Panel:
    """The live panel, and the keys of the runtime: F1..F9 modes, Esc emergency stop, F10 reset."""

    def __init__(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> None:
        from rich.live import Live

        from ibrobot_core.screen import Screen

        self._runtime = runtime
        self._hooks = hooks
        self._log = RecentLog()
        self._rates = RecentRates()
        _log_to(self._log)
        self._display = stack.enter_context(Live(console=Screen(stderr=err), auto_refresh=False, screen=False))
        self._next_s = 0.0
        self._pressed: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
        """Keys, each with the number of emergency stops when it was pressed."""
        self._acts: queue.SimpleQueue[tuple[str, Callable[[], object]] | None] = queue.SimpleQueue()
        self._acting = ""
        """The name of the present one of `_acts`."""
        self._thread = threading.Thread(target=self._act_in_turn, name="panel", daemon=True)
        self._thread.start()
        stack.callback(self._end)
        _listen(runtime.session, self._pressed.put)

    def starting(self, component: str) -> None:
        """Show the component that starts."""
        self._display.update(f"starting {component} …", refresh=True)

    def show(self) -> None:
        """Handle pressed keys, and redraw the panel."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + 1.0 / _PANEL_HZ
        while not self._pressed.empty():
            self._handle_key(*self._pressed.get())
        session, hooks = self._runtime.session, self._hooks
        self._rates.sample(session)
        rows = [*([("now", f"{acting} …")] if (acting := self._acting) else ()), *hooks.rows()]
        self._display.update(panel(session, self._log, self._rates, hooks.help(), rows), refresh=True)

    def _handle_key(self, key: str, stops: int) -> None:
        session = self._runtime.session
        if session.stops > stops:
            session.log.warning("%s was pressed before the emergency stop, which cancels it", key)
            return
        if self._hooks.key(key):
            return
        if key == "f10":
            self._act("resetting", lambda: self._runtime.reset(stops))
        elif (mode := self._runtime.session.mode_keys.get(key.upper())) is not None:
            self._act(f"entering mode {mode}", lambda: self._runtime.switch_mode(mode, stops))

    def _act(self, name: str, act: Callable[[], object]) -> None:
        """Do what may take seconds, e.g. set up a device again, in another thread, while the panel goes on."""
        if self._runtime.session.request.lockstep:
            _try(self._runtime.session, act)
        else:
            self._acts.put((name, act))

    def _end(self) -> None:
        self._acts.put(None)
        self._thread.join(1.0)  # an act that hangs must not keep the run from ending

    def _act_in_turn(self) -> None:
        while (each := self._acts.get()) is not None:
            self._acting, act = each
            try:
                _try(self._runtime.session, act)
            except Exception as error:  # noqa: BLE001 - without this thread, the keys of the panel do nothing
                self._runtime.session.fail(self._acting, error)
            self._acting = ""


def _try(session: Session, act: Callable[[], object]) -> None:
    """Run a step; log its failure."""
    try:
        act()
    except IbrobotError as error:
        session.log.error("%s", error)


def _log_to(handler: logging.Handler) -> None:
    """Log ibrobot's messages from INFO and those of libraries from WARNING to `handler`."""
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger("ibrobot").setLevel(logging.INFO)


def _print_summary(runtime: Runtime, hooks: RunHooks, as_json: bool) -> None:
    """Print the summary of a run."""
    summary = runtime.summary()
    if as_json:
        echo(json.dumps({**summary, **hooks.facts()}))
        return
    loop = summary["loop"]
    echo(f"{summary['robot']}: {summary['mode']} for {summary['duration_s']:.1f} s")
    judged, unjudged = summary["episodes"], summary["unjudged"]
    if judged or (unjudged and runtime.session.config.control_modes[summary["mode"]].inference is not None):
        more = f", {unjudged} not judged" if unjudged else ""
        echo(f"episodes   {judged + unjudged}, of which {summary['successes']} succeeded{more}")
        if summary["disturbed"]:
            echo(f"disturbed  {summary['disturbed']} episodes, by a fault or an emergency stop")
    if summary["lockstep"]:
        echo(f"loop       {loop['ticks']} ticks in lockstep")
    elif loop["ticks"]:
        echo(
            f"loop       {loop['rate_hz']:.2f} Hz, lateness p50 {loop['lateness_p50_us']:.0f} us, "
            f"p99 {loop['lateness_p99_us']:.0f} us, missed {loop['missed']}"
        )
    for heading, text in (*hooks.summary_rows(), *runtime.plan.mode.source.summary_rows()):
        echo(f"{heading:10} {text}")
    if runtime.plan.without:
        echo(f"without    {runtime.plan.without}")
    left = summary["faults_at_end"]
    were_reset = (Counter(summary["faults"]) - Counter(left)).elements()
    echo(f"faults     {'; '.join([*left, *(f'{fault} (reset)' for fault in were_reset)]) or 'none'}")
