"""The deadman: the one rule by which a teleoperation device may move the robot."""

from __future__ import annotations

import threading
from typing import ClassVar

from ibrobot_core.units import ns

_BRAKING_S = 0.1
"""Braking time until `Deadman.braking_s` is set [s]."""
_MARGIN_S = 0.06
"""Part of `Deadman.hold_s` for the control loop and the host [s]."""
_LEAST_SILENCE_S = 0.05
"""Shortest silence that disarms [s]; devices report at least three times as often."""
LONGEST_BRAKING_S = 0.2
"""Longest time to brake with which motion ends within `hold_s` [s]: the shortest silence, and as much for the control
loop and the host, come first."""
_LATE_NS = ns(0.1)
"""Time after a pause of the host in which reports from before the pause may still be read [ns]."""


class Deadman:
    """Whether a deadman allows motion. It counts only after it was seen released since it was disarmed.

    - A device calls `report` with each report that it receives of its deadman, not with a repeated old one, and moves
      while `allows`, which it asks at every tick.
    - `disarm` follows an activation (launch, mode switch, change of control, reset), a fault, a loss and a stop.
      Reports made before it do not count.
    - Silence disarms: without a report, motion ends within `hold_s` of the last one, braking included. A pause of the
      host between two calls of `allows` disarms, too.

    All times are of one clock, e.g. the stamps of measurements [ns]. Thread-safe.

    Attributes:
        braking_s: how long the robot takes to stop from its present velocity [s]; the run updates it.
    """

    hold_s: ClassVar[float] = 0.3
    """Longest motion after the last report of an engaged device, braking included [s]."""

    def __init__(self) -> None:
        self.braking_s = _BRAKING_S
        self._lock = threading.Lock()
        self._since_ns = -1
        """Only reports made later count [ns]."""
        self._armed = self._pressed = False
        """Whether it was seen released, and then pressed, since then."""
        self._made_ns = 0
        self._reported = False
        self._braking: tuple[int, int] | None = None
        """Start and end of the time in which a motion may slow down after a release or silence [ns]; None otherwise."""
        self._asked_ns: int | None = None

    @property
    def silence_ns(self) -> int:
        """The silence that disarms at present [ns]."""
        return ns(max(_LEAST_SILENCE_S, self.hold_s - _MARGIN_S - self.braking_s))

    @property
    def reported(self) -> bool:
        """Whether the device has ever reported."""
        return self._reported

    @property
    def armed(self) -> bool:
        """Whether it was seen released since it was disarmed, so that a press moves the robot."""
        with self._lock:
            return self._armed

    def report(self, pressed: bool, made_ns: int) -> None:
        """Take in a report of the device.

        Args:
            pressed: whether the deadman is pressed.
            made_ns: when the report was made, or received if the device does not say [ns].
        """
        with self._lock:
            self._reported = True
            if not pressed and self._pressed:
                # A release ends motion whenever it was made.
                self._pressed, self._braking = False, (made_ns, made_ns + ns(self.braking_s))
            if made_ns < self._made_ns or made_ns <= self._since_ns:
                return
            if self._pressed and made_ns - self._made_ns > self.silence_ns:
                self._disarm(made_ns - 1)  # a press does not outlive a silence, even if nobody asked meanwhile
            self._made_ns = made_ns
            self._armed |= not pressed
            self._pressed = pressed and self._armed

    def allows(self, now_ns: int) -> bool:
        """Whether the deadman allows motion at a time [ns]; to be called at every tick."""
        with self._lock:
            asked_ns, self._asked_ns = self._asked_ns, now_ns
            if asked_ns is not None and now_ns - asked_ns > ns(self.hold_s):
                self._disarm(now_ns + _LATE_NS)
            elif self._pressed and abs(now_ns - self._made_ns) > self.silence_ns:
                self._disarm(now_ns)
                self._braking = now_ns, now_ns + ns(self.braking_s)
            return self._pressed

    def brakes(self, now_ns: int) -> bool:
        """Whether a motion that a release or a silence has ended may still slow down at a time [ns]."""
        with self._lock:
            return self._braking is not None and self._braking[0] <= now_ns <= self._braking[1]

    def disarm(self, now_ns: int) -> None:
        """Allow nothing until reports made after `now_ns` [ns] show the deadman released, and then pressed."""
        with self._lock:
            self._disarm(now_ns)
            self._asked_ns = None

    def _disarm(self, now_ns: int) -> None:
        self._since_ns = max(now_ns, self._since_ns)
        self._made_ns = self._since_ns
        self._armed = self._pressed = False
        self._braking = None
