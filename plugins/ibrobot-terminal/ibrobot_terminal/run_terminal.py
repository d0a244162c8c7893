"""The terminal of a run: its keys, and the live panel."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, override

from rich.live import Live

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import RunDisplay, RunTerminal
from ibrobot_terminal.agent_keys import AgentKeys
from ibrobot_terminal.held_keys import RELEASE, REPEAT
from ibrobot_terminal.key_reader import KeyReader
from ibrobot_terminal.panel import GuardBell, RecentLog, kept_apart, panel
from ibrobot_terminal.screen import Screen

if TYPE_CHECKING:
    from ibrobot_core.app import RunHooks, Runtime

_PANEL_HZ = 8


class PanelTerminal(KeyReader, RunTerminal):
    """Standard input, and the panel."""

    @override
    def display(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> RunDisplay:
        return Panel(runtime, hooks, stack, err=err)


class Panel(RunDisplay):
    """The live panel, and the keys of every run: F1..F9 modes, F10 reset, and what a person grants an agent."""

    def __init__(self, runtime: Runtime, hooks: RunHooks, stack: ExitStack, *, err: bool) -> None:
        super().__init__(runtime.session)
        self._runtime = runtime
        self._hooks = hooks
        self.log: RecentLog = RecentLog()
        self._live = stack.enter_context(Live(console=Screen(stderr=err), auto_refresh=False, screen=False))
        self._agents = AgentKeys(runtime.session)
        stack.callback(self._agents.close)
        self._next_s = 0.0
        self._bell = GuardBell(self._live.console)
        self._pressed: queue.SimpleQueue[tuple[str, int]] = queue.SimpleQueue()
        """Keys, each with the number of emergency stops when it was pressed."""
        self._acts: queue.SimpleQueue[tuple[str, Callable[[], object]] | None] = queue.SimpleQueue()
        self._acting = ""
        """The name of the present one of `_acts`."""
        self._thread = threading.Thread(target=self._act_in_turn, name="panel", daemon=True)
        self._thread.start()
        stack.callback(self._end)

    @override
    def starting(self, component: str) -> None:
        self._live.update(f"starting {component} …", refresh=True)

    @override
    def press(self, key: str, stops: int) -> None:
        if not key.startswith((REPEAT, RELEASE)):
            self._pressed.put((key, stops))

    @override
    def show(self) -> None:
        """Handle pressed keys, and redraw the panel."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + 1.0 / _PANEL_HZ
        self.handle_keys()
        self.sample()
        self._bell.hear(kept_apart(self.session))
        rows = [
            *([("now", f"{acting} …")] if (acting := self._acting) else ()),
            *self._agents.rows(),
            *self._hooks.rows(),
        ]
        self._live.update(panel(self, self.log, self._hooks.help(), rows), refresh=True)

    def handle_keys(self) -> None:
        """Handle the keys pressed so far."""
        while not self._pressed.empty():
            self._handle_key(*self._pressed.get())

    def _handle_key(self, key: str, stops: int) -> None:
        session = self.session
        if session.stops > stops:
            session.log.warning("%s was pressed before the emergency stop, which cancels it", key)
            return
        if self._hooks.key(key):
            return
        if (act := self._agents.key(key)) is not None:
            self._act("answering an agent", act)
            return
        if key == "f10":
            self._act("resetting", lambda: self._runtime.reset(stops))
        elif (mode := session.mode_keys.get(key.upper())) is not None:
            self._act(f"entering mode {mode}", lambda: self._runtime.switch_mode(mode, stops))

    def _act(self, name: str, act: Callable[[], object]) -> None:
        """Do what may take seconds, e.g. set up a device again, in another thread, while the panel goes on."""
        if self.session.request.lockstep:
            self._try(act)
        else:
            self._acts.put((name, act))

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except IbrobotError as error:
            self.session.log.error("%s", error)

    def _end(self) -> None:
        self._acts.put(None)
        self._thread.join(1.0)  # an act that hangs must not keep the run from ending

    def _act_in_turn(self) -> None:
        while (each := self._acts.get()) is not None:
            self._acting, act = each
            try:
                self._try(act)
            except Exception as error:  # noqa: BLE001 - without this thread, the keys of the panel do nothing
                self.session.fail(self._acting, error)
            self._acting = ""
