"""The base of command sources that work in steps: a policy, a teleoperation device, a planner, a replay."""

from __future__ import annotations

import threading
from abc import abstractmethod
from typing import override

from ibrobot_core.config.schema import ControlMode
from ibrobot_core.launch.session import CommandSource, Session, SessionWorker


class SourceWorker(SessionWorker, CommandSource):
    """A command source with its own thread (in lockstep: its own step), for one mode."""

    def __init__(self, session: Session, mode: ControlMode, summary: str, needs: tuple[str, ...]) -> None:
        super().__init__(session, f"mode:{mode.name}", summary, needs)
        self.mode = mode
        self.active = False
        self.lock = threading.RLock()
        """Held while working, so that `begin` and `end` fall between units of work."""

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
