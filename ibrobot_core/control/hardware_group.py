"""All hardware of a robot as one object: several components with their own joints, read and written in parallel."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from typing import Any

import numpy as np

from ibrobot_core.errors import HardwareError, IbrobotError, NotSupported
from ibrobot_core.interfaces import (
    Condition,
    EpisodeSetup,
    Hardware,
    Holding,
    JointReading,
    Signal,
    SimulatedHardware,
    Torque,
)
from ibrobot_core.robot import Robot, Vector

_LOG = logging.getLogger("ibrobot.control")


class HardwareGroup:
    """All hardware of a robot, with joints in robot order.

    Args:
        robot: the joints.
        parts: name -> hardware; each joint belongs to exactly one part.
    """

    def __init__(self, robot: Robot, parts: dict[str, Hardware]) -> None:
        self._parts = parts
        self._simulated = [part for part in parts.values() if isinstance(part, SimulatedHardware)]
        self._indices = {name: robot.indices(part.joints) for name, part in parts.items()}
        self._size = len(robot.joints)
        self._off: set[str] = set()
        self._pool = ThreadPoolExecutor(len(parts)) if len(parts) > 1 else None
        self.signals: tuple[Signal, ...] = tuple(s for part in parts.values() for s in part.signals)
        self._signal_values: Vector = np.full(sum(s.size for s in self.signals), np.nan)
        # A single part with all joints in order needs no copying in the tick.
        only = next(iter(parts.values()))
        self._single = only if len(parts) == 1 and only.joints == robot.joint_names else None

    def connect(self) -> None:
        """Connect all parts; if one fails, restore the parts connected before it."""
        connected: list[str] = []
        try:
            for name, part in self._parts.items():
                _named(name, part.connect)
                connected.append(name)
        except IbrobotError:
            self.undo_connect(connected)
            self.disconnect()
            raise

    def undo_connect(self, names: Collection[str] | None = None) -> None:
        """Switch off the torque that `connect` switched on, for all parts or `names`; log what stays on."""
        for name, part in self._parts.items():
            if names is None or name in names:
                try:
                    part.undo_connect()
                except HardwareError as error:
                    _LOG.error("torque of %s cannot be taken off: %s", name, error)

    def holding(self) -> list[Holding]:
        """The parts known to hold torque."""
        return [holding for part in self._parts.values() if (holding := part.holding()) is not None]

    def health(self) -> Sequence[Condition]:
        """The conditions of the joints of all parts."""
        if self._single is not None:
            return self._single.health()
        return [condition for part in self._parts.values() for condition in part.health()]

    def disconnect(self) -> None:
        """Release all."""
        for part in self._parts.values():
            part.disconnect()
        if self._pool is not None:
            self._pool.shutdown()

    def read(self) -> JointReading:
        """Measure every joint; the stamp is the oldest of all parts.

        Raises:
            HardwareError: if a part fails; names the part.
        """
        if self._single is not None:
            return self._single.read()
        readings: list[JointReading] = list(self._each(lambda part: part.read()))
        position, velocity, effort = np.empty(self._size), np.empty(self._size), np.empty(self._size)
        for index, reading in zip(self._indices.values(), readings, strict=True):
            position[index], velocity[index], effort[index] = reading.position, reading.velocity, reading.effort
        stamp_ns = min(reading.stamp_ns for reading in readings)
        return JointReading(stamp_ns, position, velocity, effort, any(reading.stale for reading in readings))

    def write(self, command: Vector) -> None:
        """Command every joint [rad], shape (J,).

        Raises:
            HardwareError: if a part fails; names the part.
        """
        if self._single is not None and not self._off:
            self._single.write(command)
            return
        commands = {id(part): command[self._indices[name]] for name, part in self._parts.items()}
        self._each(lambda part: part.write(commands[id(part)]), but=self._off)

    def relax(self) -> dict[str, Torque | IbrobotError]:
        """Switch torque off; return for each part the result, or the error that kept its torque on.

        Until `resume`, only parts whose torque stays on are written.
        """
        outcomes: dict[str, Torque | IbrobotError] = dict(zip(self._parts, self._each(_relaxed), strict=True))
        self._off = {name for name, outcome in outcomes.items() if isinstance(outcome, Torque)}
        return outcomes

    def resume(self) -> None:
        """Write all parts again; the next `write` switches torque back on."""
        self._off.clear()

    @property
    def holds(self) -> bool:
        """Whether any part is still written, so that its joints hold their position."""
        return len(self._off) < len(self._parts)

    def require_relax(self) -> None:
        """Check that every part can switch torque off.

        Raises:
            NotSupported: if a part cannot; names the part.
        """
        for name, part in self._parts.items():
            if type(part).relax is Hardware.relax:
                raise NotSupported(f"control.stop: relax: hardware {name!r} cannot take torque off; use hold or a pose")

    def reset_faults(self) -> None:
        """Clear the latched faults of all parts."""
        self._each(lambda part: part.reset_faults())

    def counters(self) -> dict[str, dict[str, int]]:
        """The counters of each part; parts without counters are omitted."""
        return {name: counts for name, part in self._parts.items() if (counts := dict(part.counters()))}

    def read_signals(self) -> Vector:
        """The concatenated signals of all parts, shape (S,); the next call reuses the array."""
        begin = 0
        for part in self._parts.values():
            for index, signal in enumerate(part.signals):
                part.read_signal(index, self._signal_values[begin : begin + signal.size])
                begin += signal.size
        return self._signal_values

    def advance(self, step_ns: int) -> None:
        """Advance the simulated parts."""
        for part in self._simulated:
            part.advance(step_ns)

    def reset_episode(self, episode: EpisodeSetup) -> None:
        """Reset the simulated scenes.

        Raises:
            NotSupported: if no part is simulated.
        """
        if not self._simulated:
            raise NotSupported("only a simulation can be set up again")
        for part in self._simulated:
            part.reset(episode)

    def success(self) -> bool | None:
        """Whether the scene's task is done; None if it has no task."""
        return self._simulated[0].success() if self._simulated else None

    def _each(self, act: Callable[[Hardware], Any], but: Collection[str] = ()) -> Sequence[Any]:
        parts = [(name, part) for name, part in self._parts.items() if name not in but]
        if self._pool is None:
            return [_named(name, partial(act, part)) for name, part in parts]
        futures = [(name, self._pool.submit(act, part)) for name, part in parts]
        wait([future for _, future in futures])  # even if one fails, so that no part is called twice at once
        return [_named(name, future.result) for name, future in futures]


def _relaxed(part: Hardware) -> Torque | IbrobotError:
    try:
        return part.relax()
    except (HardwareError, NotSupported) as error:
        return error


def _named(name: str, act: Callable[[], Any]) -> Any:
    try:
        return act()
    except HardwareError as error:
        text = str(error)
        raise HardwareError(text if name in text else f"{name}: {text}") from error
