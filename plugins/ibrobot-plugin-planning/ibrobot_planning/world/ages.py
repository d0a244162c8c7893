"""Ages of the parts of the world, and the reaction to one that is too old."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from typing import Literal

import attrs

from ibrobot_core.api import Clock, ns, seconds

_FIRST_S = 5.0
"""Goals wait this long after the start for the first message of a cloud [s]."""
WhenStale = Literal["refuse", "keep", "forget"]
"""What planners do about a part of the world that is too old: refuse to plan, keep what was seen last, forget it."""
_THEN: Mapping[WhenStale, str] = {
    "refuse": "plans are refused", "keep": "planners keep what was seen last", "forget": "planners do without it",
}  # fmt: skip


class Unusable(ValueError):
    """A message or request that cannot renew a part of the world.

    Args:
        reason: one of a few short texts, for counts, e.g. `too old`.
        message: the whole reason.
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@attrs.frozen
class Limit:
    """How old a part of the world may be, and the rule beyond; with the keys that state them, for errors."""

    max_age: float | None = None
    """[s]; None: it never gets too old."""
    when_stale: WhenStale = "refuse"
    max_age_key: str = "max_age"
    when_stale_key: str = "when_stale"

    @classmethod
    def of(cls, section: str, max_age: float | None, when_stale: WhenStale) -> Limit:
        """The limit that the keys `max_age` and `when_stale` of a section state, e.g. of `world.clouds.top`."""
        return cls(max_age, when_stale, f"{section}.max_age", f"{section}.when_stale")


@attrs.frozen
class AgeSummary:
    """How old a part of the world is."""

    age_s: float | None
    """[s]; None before the first usable message."""
    max_age_s: float | None
    """Its limit [s]; None: it never gets too old."""
    when_stale: str
    is_stale: bool
    """Whether it is older than its limit, or has never been seen."""
    problem: str
    """Why it is not fresh, or why the newest message was refused; empty otherwise."""
    refused: Mapping[str, int]
    """Reason -> number of messages refused for it."""


@attrs.define(eq=False)
class Age:
    """The time at which a part of the world was measured. Times are those of the run's clock.

    The part ages by the run's clock from then on, so that it does not matter if the computer's clock is set.
    """

    what: str
    """E.g. `cloud 'top' (/camera/top/points)`."""
    limit: Limit
    clock: Clock
    log: logging.Logger
    begun_ns: int
    """When it was first expected [ns]."""
    measured_ns: int | None = None
    """[ns]; None before the first usable message."""
    refused: Counter[str] = attrs.field(factory=Counter)
    _fault: str = ""
    """Why the newest message was refused; empty if it was not."""
    _was_stale: bool = False

    def measured_at(self, stamp_ns: int, received_ns: int) -> int:
        """When something was measured, by its stamp [ns]; a stamp of 0 stands for its receipt.

        Raises:
            Unusable: if it is too old, in the future, or older than what is known.
        """
        stamp_ns = stamp_ns or received_ns
        age_ns = self.clock.age_ns(stamp_ns)
        if age_ns < 0 and self.clock.refusal(stamp_ns):
            raise Unusable("in the future", f"its stamp is {seconds(-age_ns):.1f} s in the future; set the clocks")
        if self._is_beyond(age_ns):
            message = f"it is {seconds(age_ns):.1f} s old by its stamp; set the clocks, or find what delays it"
            raise Unusable("too old", message)
        measured_ns = self.clock.now_ns() - max(age_ns, 0)
        if self.measured_ns is not None and measured_ns < self.measured_ns:
            raise Unusable("out of order", "it is older than the one before, by its stamp")
        return measured_ns

    def renew(self, measured_ns: int) -> None:
        """Note that it was measured at a time of `measured_at` [ns]."""
        self.measured_ns, self._fault = measured_ns, ""

    def refuse(self, error: Exception) -> None:
        """Count a message that cannot be used; the first for each reason is logged."""
        reason = error.reason if isinstance(error, Unusable) else "malformed"
        self.refused[reason] += 1
        self._fault = str(error)
        if self.refused[reason] == 1:
            self.log.warning("%s: refused a message: %s", self.what, error)

    @property
    def is_stale(self) -> bool:
        """Whether it is older than its limit, or was never measured."""
        return self.measured_ns is None or self._is_beyond(self.clock.now_ns() - self.measured_ns)

    @property
    def is_awaited(self) -> bool:
        """Whether the run has just begun, and the first measurement may still come."""
        return self.measured_ns is None and self.clock.now_ns() - self.begun_ns <= ns(_FIRST_S)

    @property
    def refuses(self) -> bool:
        """Whether plans are refused: also under the rule `keep`, if there is nothing yet to keep."""
        rule = self.limit.when_stale
        return self.is_stale and (rule == "refuse" or (rule == "keep" and self.measured_ns is None))

    @property
    def problem(self) -> str:
        """Why it is stale; if it is not, why the newest message was refused. Empty if all is well."""
        newest = f"; the newest message was refused: {self._fault}" if self._fault else ""
        if not self.is_stale:
            return f"{self.what}{newest}" if newest else ""
        limit, now_ns = self.limit, self.clock.now_ns()
        if self.measured_ns is None:
            since_s = seconds(now_ns - self.begun_ns)
            return f"{self.what}: nothing usable has come for {since_s:.1f} s{newest}"
        return (
            f"{self.what} is {seconds(now_ns - self.measured_ns):.1f} s old, at most {limit.max_age:g} s is allowed"
            f" ({limit.max_age_key}){newest or '; nothing newer has come'}"
        )

    @property
    def remedy(self) -> str:
        """Remedy of a refusal."""
        return f"mend what measures it, or set {self.limit.when_stale_key}, which is {self.limit.when_stale}"

    @property
    def summary(self) -> AgeSummary:
        """Its present state."""
        age_s = None if self.measured_ns is None else seconds(self.clock.now_ns() - self.measured_ns)
        return AgeSummary(
            age_s, self.limit.max_age, self.limit.when_stale, self.is_stale, self.problem, dict(self.refused)
        )

    def report(self) -> None:
        """Log when it gets too old, and when it is fresh again."""
        was_stale, self._was_stale = self._was_stale, self.is_stale and not self.is_awaited
        if self._was_stale and not was_stale:
            then = _THEN["refuse" if self.refuses else self.limit.when_stale]
            self.log.warning("%s; %s", self.problem, then)
        elif was_stale and not self._was_stale:
            self.log.info("%s is seen again", self.what)

    def _is_beyond(self, age_ns: int) -> bool:
        return self.limit.max_age is not None and age_ns > ns(self.limit.max_age)
