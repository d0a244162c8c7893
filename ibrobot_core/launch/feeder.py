"""Feeders: what gives the active executors something to do in a mode: a policy, a teleop device, a planner."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from ibrobot_core.config.schema import ControlMode
from ibrobot_core.launch.component import Worker
from ibrobot_core.launch.session import Session


class Feeder(Worker):
    """Works for one mode. It is quiet until `begin`, and after `end`."""

    def __init__(self, session: Session, mode: ControlMode, summary: str, needs: tuple[str, ...]) -> None:
        super().__init__(
            f"mode:{mode.name}", summary, needs, on_failure=session.fail, lockstep=session.request.lockstep
        )  # fmt: skip
        self.session = session
        self.mode = mode
        self.active = False
        self.lock = threading.RLock()
        """Held while working, so that `begin` and `end` fall between units of work."""

    def begin(self, seed: int) -> None:
        """The mode was entered, or control was reset: start afresh."""
        with self.lock:
            self.begin_feeding(seed)
            self.active = True

    def end(self) -> None:
        """The mode is left."""
        with self.lock:
            if self.active:
                self.active = False
                self.end_feeding()

    @abstractmethod
    def begin_feeding(self, seed: int) -> None:
        """Start afresh from the measured state, with the lock held."""

    def end_feeding(self) -> None:
        """Stop, with the lock held."""

    def take_goal(self, event: Mapping[str, Any]) -> None:
        """A goal of an executor changed its state."""

    def help(self) -> str:
        """What an operator must know in this mode."""
        return ""
