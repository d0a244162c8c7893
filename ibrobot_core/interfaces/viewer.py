"""Viewers, which show the robot to a user, in the host."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Viewer(ABC):
    """Shows data of the bus (`ctx.bus`). A viewer never slows the robot down: it skips messages that it cannot show.

    All methods are called from one thread.
    """

    @abstractmethod
    def open(self) -> None:
        """Show the window or start the server.

        Raises:
            IbrobotError: e.g. if there is no display.
        """

    @abstractmethod
    def update(self) -> bool:
        """Show new data; returns False after the user has closed the viewer. Called about 30 times per second."""

    @abstractmethod
    def close(self) -> None:
        """Close it. Safe to call twice."""

    def where(self) -> str:
        """Address of the view, e.g. a URL."""
        return ""
