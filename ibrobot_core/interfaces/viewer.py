"""Viewers: what shows a person the robot; runs in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Viewer(ABC):
    """Reads the bus (`ctx.bus`) and shows it. A viewer never slows the robot: it skips what it cannot show.

    All methods are called from one thread.
    """

    @abstractmethod
    def open(self) -> None:
        """Show the window or start the server.

        Raises:
            IbrobotError: e.g. no display.
        """

    @abstractmethod
    def update(self) -> bool:
        """Show what is new on the bus; False once the person has closed it. Called about 30 times a second."""

    @abstractmethod
    def close(self) -> None:
        """Close it. Safe to call twice."""

    def where(self) -> str:
        """Where to look, e.g. a URL."""
        return ""
