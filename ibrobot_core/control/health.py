"""Conditions of joints over time: when they begin, which are faults, and which have lasted until load must be shed."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence

from ibrobot_core.interfaces.hardware import Condition, Severity
from ibrobot_core.schema import Shedding
from ibrobot_core.units import ns

_Key = tuple[str, str]
"""Joint and quantity."""


class Health:
    """Tracks how long each condition has lasted, and logs a warning when one begins.

    Args:
        options: how long a condition may last before load is shed.
        log: for warnings.
    """

    def __init__(self, options: Shedding, log: logging.Logger) -> None:
        self._after_ns = ns(options.after)
        self._log = log
        self._since_ns: dict[_Key, int] = {}
        self._known: Collection[_Key] = ()
        self.conditions: Sequence[Condition] = ()
        """The current conditions."""

    def restart(self) -> None:
        """Restart the timing of all conditions."""
        self._since_ns.clear()

    def update(self, conditions: Sequence[Condition], now_ns: int) -> None:
        """Update with the conditions at `now_ns` [ns]."""
        present = {(condition.joint, condition.quantity): condition for condition in conditions}
        for key, condition in present.items():
            if condition.severity is Severity.WARNING and key not in self._known:
                self._log.warning("%s", condition.message)
        self._known = present
        self._since_ns = {
            key: self._since_ns.get(key, now_ns) for key, condition in present.items() if condition.sheds_load
        }
        self.conditions = conditions

    @property
    def fault(self) -> str:
        """The message of a condition that is a fault; empty if there is none."""
        return next((each.message for each in self.conditions if each.severity is Severity.FAULT), "")

    def overdue(self, now_ns: int) -> str:
        """The message of a condition that has lasted until load must be shed; empty if there is none."""
        for condition in self.conditions:
            since_ns = self._since_ns.get((condition.joint, condition.quantity), now_ns)
            if now_ns - since_ns >= self._after_ns:
                return condition.message
        return ""
