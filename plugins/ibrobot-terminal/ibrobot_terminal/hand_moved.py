"""Devices that a hand moves and the robot follows, e.g. leader arms: a deadman by a key, and the approach to them."""

from __future__ import annotations

import queue
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Context, Deadman, TeleopCommand, TeleopError, Vector, seconds
from ibrobot_terminal.hand_moved_options import HandMovedOptions
from ibrobot_terminal.held_keys import HeldKeys

_LONGEST_STEP_S = 0.1
"""Longest time step of an approach, e.g. after a pause of the host [s]."""


class HandMoved:
    """Whether the robot follows such a device, and its setpoints: it approaches the device's pose, then follows it.

    Args:
        options: those of the device.
        ctx: that of the device.
        device: what it is called, e.g. `leader arm`.
        moved: a joint whose position changed by more was moved by hand; in the unit of the positions of `engaged`.
    """

    def __init__(self, options: HandMovedOptions, ctx: Context, device: str, moved: float) -> None:
        self._options = options
        self._ctx = ctx
        self._device = device
        self._moved = moved
        self._held = HeldKeys(options.release)
        self._keys: queue.SimpleQueue[str] | None = None
        self._toggled = self._taken_up = False
        self._resting: NDArray[Any] | None = None
        """The device's positions at the start of the mode; None until all are read."""
        self._setpoint: Vector | None = None
        """The last one [rad], shape (S,); None while the robot does not follow."""
        self._following = False
        """Whether the approach has ended."""
        self._set_ns = 0

    def check(self) -> None:
        """Check for the terminal that the deadman needs, before the device is connected.

        Raises:
            TeleopError: if there is none.
        """
        if self._options.deadman != "none" and self._ctx.keys is None:
            raise TeleopError(
                f"{self._ctx.name}: deadman: {self._options.deadman} needs a terminal: start ibrobot in one, without "
                "--headless and without redirecting its input, or set deadman: none, so that the robot follows once "
                f"the {self._device} is moved"
            )

    def connect(self) -> None:
        """Listen to the keys, once the device is connected."""
        self._keys = self._ctx.keys() if self._ctx.keys is not None else None

    def disconnect(self) -> None:
        """Stop listening to the keys."""
        self._keys = None

    def activate(self, now_ns: int) -> None:
        """Begin a mode, paused."""
        self.take(now_ns)
        self._held.forget()
        self._release()

    def take(self, now_ns: int) -> None:
        """Read the keys; call it at every tick, at the time `now_ns` [ns]."""
        self._held.take(self._keys, now_ns)

    def engaged(self, positions: NDArray[Any], *, complete: bool = True) -> bool:
        """Whether the deadman is pressed.

        Args:
            positions: the device's, shape (S,).
            complete: whether all of them have been read; if not, they do not yet count as those at rest.
        """
        key = self._options.deadman_key
        match self._options.deadman:
            case "toggle":
                self._toggled = self._held.toggled(key, self._toggled)
                return self._toggled
            case "hold":
                return self._held.held(key)
        if self._resting is None:
            self._resting = positions.copy() if complete else None
        else:
            self._taken_up = self._taken_up or bool(np.abs(positions - self._resting).max() > self._moved)
        return self._taken_up

    def command(
        self, deadman: Deadman, joints: Sequence[str], measured: Vector, pose: Vector | None, speed: Vector, now_ns: int
    ) -> TeleopCommand:
        """The command at a time.

        Args:
            deadman: that of the device; it has the newest report.
            joints: joints of the robot.
            measured: their positions [rad], shape (S,).
            pose: the device's pose [rad], shape (S,); None while it is unknown.
            speed: of the approach [rad/s], shape (S,).
            now_ns: the time [ns].
        """
        if not deadman.allows(now_ns) or pose is None:
            self._setpoint = None
            if not deadman.armed:
                self._release()
            return TeleopCommand(None)
        setpoint = self._setpoint = self._next(measured, pose, speed, now_ns)
        return TeleopCommand(dict(zip(joints, setpoint.tolist(), strict=True)), approaching=not self._following)

    def help(self) -> str:
        """What the operator can do now."""
        key, device = self._options.deadman_key, self._device
        start = {
            "none": f"move the {device} to start",
            "toggle": f"press {key} to follow the {device}",
            "hold": f"hold {key} to follow the {device}{'' if self._held.exact else ' (known by its repeats)'}",
        }
        pause = {"none": "", "toggle": f": {key} pauses", "hold": f": release {key} to pause"}
        deadman, paused = self._options.deadman, self._setpoint is None
        return f"PAUSED: {start[deadman]}" if paused else f"following the {device}{pause[deadman]}"

    def _next(self, measured: Vector, pose: Vector, speed: Vector, now_ns: int) -> Vector:
        """The setpoint, which moves from the measured positions to the device's pose."""
        elapsed_s, self._set_ns = min(seconds(now_ns - self._set_ns), _LONGEST_STEP_S), now_ns
        if self._setpoint is None:
            self._following = False
            return measured
        way = pose - self._setpoint
        self._following |= bool(np.abs(way).max() <= self._options.follow_tolerance)
        # All joints arrive together; the one with the longest distance sets the pace.
        share = float(np.min(speed * elapsed_s / np.maximum(np.abs(way), 1e-9)))
        return pose if self._following or share >= 1.0 else self._setpoint + way * share

    def _release(self) -> None:
        """Return to the paused state, so that following begins with an approach."""
        self._setpoint = self._resting = None
        self._toggled = self._taken_up = False
