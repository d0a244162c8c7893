"""Log lines that a flood of equal causes must not repeat."""

from __future__ import annotations

from collections.abc import Callable

from ibrobot_core.api import Clock

EVERY_NS = 10_000_000_000
"""Least time between two lines about one cause [ns]."""


class LogLimiter:
    """Logs the first of many lines about one cause, then one every 10 s, with the number of those left out.

    Args:
        clock: the clock of the run.
        log: logs a line, e.g. `session.log.warning`.
    """

    def __init__(self, clock: Clock, log: Callable[[str], None]) -> None:
        self._clock, self._log = clock, log
        self._causes: dict[str, tuple[int, int]] = {}
        """Cause -> when its last line was logged [ns], and the number of lines left out since."""

    def __call__(self, cause: str, line: str) -> None:
        """Log a line, unless one about its cause was logged a moment ago."""
        now_ns = self._clock.now_ns()
        logged_ns, left_out = self._causes.get(cause, (now_ns - EVERY_NS, 0))
        due = now_ns - logged_ns >= EVERY_NS
        self._causes[cause] = (now_ns, 0) if due else (logged_ns, left_out + 1)
        if due:
            self._log(f"{line} (and {left_out} more like it before)" if left_out else line)
