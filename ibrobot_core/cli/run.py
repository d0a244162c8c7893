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

from ibrobot_core.cli.display import Lines, RunDisplay, RunTerminal
from ibrobot_core.clock import RealClock
from ibrobot_core.config import RobotConfig
from ibrobot_core.descriptors import Options
from ibrobot_core.errors import IbrobotError, PluginError, RequestError, TeleopError
from ibrobot_core.interfaces import Context
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.models import check_models
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.output_thread import discard, output_aside
from ibrobot_core.plugins import Registry, installed_plugins
from ibrobot_core.pulses import Pulse
from ibrobot_core.run_hooks import RunHooks
from ibrobot_core.safe_output import echo
from ibrobot_core.schema import TerminalConfig
from ibrobot_core.signals import end_signals

NOT_ALL_SUCCEEDED = 3
_FAULTED = 1
_INTERRUPTED_TWICE = 130
_SHOWN_HZ = 8
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
        output = sys.stderr if as_json else sys.stdout
        terminal = None
        if not (headless or dry_run) and (sys.stdin.isatty() or output.isatty()):
            terminal = _terminal(config, installed_plugins())
        keys = terminal if sys.stdin.isatty() else None
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
            status = _run(runtime, hooks, signals, terminal if output.isatty() else None, as_json=as_json)
        finally:
            for line in runtime.session.outcome.holding:
                echo(line, err=True)
    _print_summary(runtime, hooks, as_json)
    runtime.raise_failure()
    sys.exit(status)


def _terminal(config: RobotConfig, registry: Registry) -> RunTerminal | None:
    """The terminal of a run, or None and a warning if no plugin has one."""
    try:
        chosen = config.terminal or TerminalConfig(type=registry.default("terminal"), options=Options())
    except PluginError as error:
        logging.getLogger("ibrobot").warning("neither panel nor keys, so Esc does not stop the robot: %s", error)
        return None
    context = Context.of(config, "terminal", RealClock())
    return registry.create("terminal", chosen.type, chosen.options, context)  # type: ignore[no-any-return]


def _run(
    runtime: Runtime, hooks: RunHooks, signals: _Signals, terminal: RunTerminal | None, *, as_json: bool
) -> int:  # fmt: skip
    """Start, run and stop; return the exit status of a run without failures.

    The terminal shows the run, or else status lines do, on standard output, or on standard error with `as_json`.

    Raises:
        KeyboardInterrupt: if a signal came before the run began.
    """
    session = runtime.session
    where = "simulation" if session.config.simulated else "hardware"
    with ExitStack() as stack:
        if terminal is None:
            display: RunDisplay = Lines(runtime, hooks, err=as_json)
        else:
            display = terminal.display(runtime, hooks, stack, err=as_json)
        _log_to(display.log)
        _listen(session, display.press)
        config = session.config
        session.log.info("%s from %s: %s, mode %s", config.robot.name, config.source, where, session.mode)
        runtime.start(display.starting)
        stack.callback(runtime.stop)
        if signals.came:
            raise KeyboardInterrupt
        while not (runtime.step() if session.request.lockstep else runtime.wait(1.0 / _SHOWN_HZ)):
            hooks.step()
            display.show()
    outcome = session.outcome
    if session.faults:
        return _FAULTED
    return NOT_ALL_SUCCEEDED if outcome.successes < outcome.episodes or outcome.goals_failed else 0


def _watch_keys(session: Session, keys: RunTerminal) -> None:
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

    def __init__(self, session: Session, keys: RunTerminal | None) -> None:
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


def _listen(session: Session, take: Callable[[str, int], None]) -> None:
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
                key = keys.get(timeout=Pulse.period_s)
                if key == "esc":
                    _try(session, session.emergency_stop)
                else:
                    take(key, session.stops)

    threading.Thread(target=work, name="runtime keys", daemon=True).start()


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
            echo(f"disturbed  {summary['disturbed']} of them, by a fault or an emergency stop")
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
