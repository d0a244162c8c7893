"""Feeders: what gives the active executors something to do in a mode: a policy, a teleop device, a planner."""

from __future__ import annotations

import threading
from abc import abstractmethod
from typing import override

from ibrobot_core.config.schema import ControlMode
from ibrobot_core.launch.session import Feed, Session, SessionWorker


class Feeder(SessionWorker, Feed):
    """A feed that works in units, for one mode."""

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
            self.begin_feeding(seed)
            self.active = True

    @override
    def end(self) -> None:
        with self.lock:
            if self.active:
                self.active = False
                self.end_feeding()

    @abstractmethod
    def begin_feeding(self, seed: int) -> None:
        """Start afresh from the measured state, with the lock held."""

    def end_feeding(self) -> None:
        """Stop, with the lock held."""
