"""Filter of implausible readings of the joints, and the time since the last plausible one."""

from __future__ import annotations

import itertools
import time

import attrs
import numpy as np

from ibrobot_core.clock import Clock
from ibrobot_core.control.hardware_group import HardwareGroup
from ibrobot_core.control.plausible import Plausibility
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces import JointReading
from ibrobot_core.robot import Robot

_FIRST = 10
"""Least number of attempts to get a first reading, since single replies may be lost."""


class Readings:
    """Reads the joints once per tick.

    Args:
        hardware: the joints.
        robot: the limits that make a reading plausible.
        clock: the source of stamps.
        period_ns: the control period [ns].
        timeout_ns: time without a new state after which it is a fault [ns].

    Attributes:
        newest: the newest reading; stale if this tick brought no plausible one.
        counts: failed reads, ticks without a new state, and readings that were not believed.
    """

    newest: JointReading

    def __init__(self, hardware: HardwareGroup, robot: Robot, clock: Clock, period_ns: int, timeout_ns: int) -> None:
        self._hardware = hardware
        self._clock = clock
        self._timeout_ns = timeout_ns
        self._plausibility = Plausibility(robot, period_ns)
        self._answered_ns = 0
        self.counts = {"read_errors": 0, "stale_states": 0, "implausible_states": 0}

    def first(self, patience_s: float = 0.0) -> JointReading:
        """A reading that agrees with the one before it: the command begins there.

        Args:
            patience_s: how long to try [s].

        Raises:
            HardwareError: if there is none.
        """
        deadline_s = time.monotonic() + patience_s
        last: JointReading | None = None
        wrong = ""
        for number in itertools.count(1):
            measured = self._hardware.read()
            if not measured.stale:
                wrong = self._plausibility.jump((last or measured).position, measured.position, 0)
                if last is not None and not wrong:
                    self._answered_ns = measured.stamp_ns
                    return measured
                last = measured if np.isfinite(measured.position).all() else None
            else:
                time.sleep(0.001)  # hardware that reads in a thread of its own is stale at once
            if number > _FIRST and time.monotonic() >= deadline_s:
                raise HardwareError(wrong or "the joints do not answer yet")
        raise AssertionError

    def read(self) -> str | None:
        """Read the joints, and return the fault; None without one."""
        try:
            measured = self._hardware.read()
        except HardwareError as error:
            # The driver has already retried what it can.
            self.counts["read_errors"] += 1
            self.newest = attrs.evolve(self.newest, stale=True)
            return str(error)
        if measured.stamp_ns > self._clock.now_ns():  # a clock that is ahead would hide silence and jumps
            measured = attrs.evolve(measured, stamp_ns=self._clock.now_ns())
        wrong = self._implausible(measured)
        if wrong:
            self.counts["implausible_states"] += 1
            # As after a lost reply, with the positions of the reading before it.
            measured = attrs.evolve(self.newest, stamp_ns=measured.stamp_ns, stale=True)
        self.newest = measured
        if not measured.stale:
            self._answered_ns = measured.stamp_ns
            return None
        self.counts["stale_states"] += 1
        why = wrong or "the joints do not answer"
        return f"{why}: no state for {self._age_ns / 1e6:.0f} ms" if self.silent else None

    @property
    def silent(self) -> bool:
        """Whether there has been no new state for too long."""
        return self._age_ns >= self._timeout_ns

    @property
    def _age_ns(self) -> int:
        return self._clock.now_ns() - self._answered_ns

    def _implausible(self, measured: JointReading) -> str:
        """Why no joint can have moved like that; empty if it can, and for a stale reading of finite positions."""
        if measured.stale and np.isfinite(measured.position).all():
            return ""
        # Silence beyond the timeout is a fault: the next reset believes what is measured, and nothing before it.
        since_ns = min(measured.stamp_ns - self._answered_ns, self._timeout_ns)
        return self._plausibility.jump(self.newest.position, measured.position, since_ns)
