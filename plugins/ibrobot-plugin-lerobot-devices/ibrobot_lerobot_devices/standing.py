"""A base after a fault: it is made to stand, by whatever still can."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any

from ibrobot_lerobot_devices.link import DeviceLink, DeviceProblem

MAY_DRIVE = "the base may still be driving: switch it off"
_PATIENCE_S = 0.15
"""How long a process may be silent; then another one takes its place [s]."""
_TRY_S = 1.0
"""How long a process that answers may try [s]."""
_HOPE_S = 0.5
"""Delay of the warning that the base may still be driving [s]."""
_PAUSE_S = 1.0
"""Time until another process is started after one that could not connect [s]."""


class Standing:
    """Makes a base stand, from a fault on, until LeRobot has confirmed it.

    It asks the device process, which uses an action, LeRobot's own call, or the torque of the wheels. A process that
    was stopped is continued for that, and one that does not answer is killed. Another process takes the place of one
    that has died, and stops the base when it connects.

    Args:
        link: the device process.
        log: receives the events of the base.

    Attributes:
        is_starting: whether a new process connects; it takes nothing but the order to end.
        found: what the device of a new process says about itself; None without a new process that has connected.
    """

    def __init__(self, link: DeviceLink, log: logging.Logger) -> None:
        self._link = link
        self._log = log
        self._begun_s = self._answered_s = time.monotonic()
        self._again_s = self._begun_s
        """When the next process may be started [s]."""
        self._is_confirmed = False
        self._said = ""
        self.is_starting = False
        self.found: Mapping[str, Any] | None = None

    @property
    def is_in_doubt(self) -> bool:
        """Whether the base may still be driving, although there was time to stop it."""
        return not self._is_confirmed and time.monotonic() - self._begun_s > _HOPE_S

    def step(self) -> None:
        """Go on; to be called at every tick, never blocks."""
        if self._is_confirmed:
            return
        if self.is_in_doubt:
            self._say(MAY_DRIVE)
        try:
            if self.is_starting:
                self._connect(0.0)
            elif self._link.pid is None:
                self._start()
            else:
                self._ask()
        except DeviceProblem as problem:
            self.is_starting = False
            self._again_s = time.monotonic() + _PAUSE_S
            self._say(f"cannot stop the base yet: {problem}")

    def restart(self, timeout_s: float) -> Mapping[str, Any] | None:
        """Start a process if none runs; return what its device says, or None if that takes more than `timeout_s` [s].

        Raises:
            DeviceProblem: if it cannot be connected.
        """
        if self.found is None:
            if not self.is_starting:
                self._again_s = 0.0
                self._start()
            try:
                self._connect(timeout_s)
            except DeviceProblem:
                self.is_starting = False
                raise
        return self.found

    def _ask(self) -> None:
        answer, now_s = self._link.stand(), time.monotonic()
        if answer is not None:
            self._answered_s = now_s
            self._confirm(not answer)
        if not self._is_confirmed and (now_s - self._answered_s > _PATIENCE_S or now_s - self._begun_s > _TRY_S):
            self._link.kill()

    def _start(self) -> None:
        if time.monotonic() >= self._again_s:
            self._link.begin()
            self.is_starting = True

    def _connect(self, timeout_s: float) -> None:
        self.found = self._link.poll_start(timeout_s)
        if self.found is not None:
            self.is_starting = False
            self._confirm(True)

    def _confirm(self, stands: bool) -> None:
        if stands and not self._is_confirmed:
            self._is_confirmed = True
            self._log.warning("the base stands: LeRobot has stopped it")

    def _say(self, text: str) -> None:
        if text != self._said:
            self._said = text
            self._log.error("%s", text)
