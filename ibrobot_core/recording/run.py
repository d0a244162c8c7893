"""What recording needs of a run; `ibrobot_core.launch.session.Session` is one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Protocol

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock
from ibrobot_core.config import RobotConfig
from ibrobot_core.interfaces import Context
from ibrobot_core.plugins import Registry


class RunRequest(Protocol):
    """What a user asks of a run, as far as it concerns recording."""

    @property
    def lockstep(self) -> bool:
        """Whether equal runs must give equal bytes."""

    @property
    def seed(self) -> int:
        """Of the first episode's scene."""

    @property
    def prompt(self) -> str:
        """What episodes are recorded under."""

    @property
    def by_operator(self) -> bool:
        """Whether an operator begins and ends episodes, rather than the mode."""


class EpisodeCounts(Protocol):
    """Episodes that were judged."""

    episodes: int
    successes: int


class Run(Protocol):
    """A run whose episodes are recorded. Safe to read from any thread."""

    @property
    def config(self) -> RobotConfig:
        """The robot."""

    @property
    def registry(self) -> Registry:
        """The installed plugins."""

    @property
    def request(self) -> RunRequest:
        """What the user asks of the run."""

    @property
    def clock(self) -> Clock:
        """The run's clock."""

    @property
    def bus(self) -> Bus:
        """The run's topics and services."""

    @property
    def log(self) -> logging.Logger:
        """The run's log."""

    @property
    def mode(self) -> str:
        """The present control mode."""

    @property
    def policy(self) -> Callable[[], Mapping[str, str]] | None:
        """Says which policy acts, and with which weights; None in a mode without one."""

    @property
    def outcome(self) -> EpisodeCounts:
        """What came of the run so far."""

    def context(self, name: str) -> Context:
        """What a plugin's component is given."""

    def begin_source(self) -> None:
        """Have the mode move the robot, again where it paused."""

    def pause_feed(self) -> None:
        """Have the mode no longer move the robot, until `feed`."""

    def finish(self) -> None:
        """End the run in good order."""

    def add_fault(self, fault: str) -> None:
        """Note a fault; the run goes on."""

    def fail(self, component: str, error: Exception) -> None:
        """End the run: a component failed."""
