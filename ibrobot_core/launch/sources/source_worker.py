"""Base class of the command sources for policies, teleoperation devices, planners and plugins."""

from __future__ import annotations

import threading
from abc import abstractmethod
from typing import override

from ibrobot_core.component import CONTROL, SessionWorker
from ibrobot_core.config.schema import ControlMode
from ibrobot_core.launch.session import CommandSource
from ibrobot_core.launch.views import RunAccess


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

    session: RunAccess

    def __init__(
        self, session: RunAccess, mode: ControlMode, summary: str, needs: tuple[str, ...] = (CONTROL,)
    ) -> None:
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
