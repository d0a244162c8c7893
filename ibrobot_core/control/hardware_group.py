"""The hardware of a robot as one: several components, each owning joints, read and written in parallel in a tick."""

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
    """All the hardware of a robot, in robot order.

    Args:
        robot: the joints.
        parts: name -> hardware; together they own every joint once.
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
        # One part that owns every joint in order: no gathering in the tick.
        only = next(iter(parts.values()))
        self._single = only if len(parts) == 1 and only.joints == robot.joint_names else None

    def connect(self) -> None:
        """Connect all; where one fails, those before it are as they were."""
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
        """Take off the torque that `connect` put on, of all parts or those of `names`; what stays on is logged."""
        for name, part in self._parts.items():
            if names is None or name in names:
                try:
                    part.undo_connect()
                except HardwareError as error:
                    _LOG.error("torque of %s cannot be taken off: %s", name, error)

    def holding(self) -> list[Holding]:
        """What holds torque, as far as is known."""
        return [holding for part in self._parts.values() if (holding := part.holding()) is not None]

    def health(self) -> Sequence[Condition]:
        """What is wrong with the joints of all parts."""
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
        """Measure every joint; the stamp is the oldest of the parts'.

        Raises:
            HardwareError: with the name of the part that failed.
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
            HardwareError: with the name of the part that failed.
        """
        if self._single is not None and not self._off:
            self._single.write(command)
            return
        commands = {id(part): command[self._indices[name]] for name, part in self._parts.items()}
        self._each(lambda part: part.write(commands[id(part)]), but=self._off)

    def relax(self) -> dict[str, Torque | IbrobotError]:
        """Take torque off; for each part what became of it, or why its torque stays on.

        From then on only parts whose torque stays on are written, until `resume`.
        """
        outcomes: dict[str, Torque | IbrobotError] = dict(zip(self._parts, self._each(_relaxed), strict=True))
        self._off = {name for name, outcome in outcomes.items() if isinstance(outcome, Torque)}
        return outcomes

    def resume(self) -> None:
        """Write all parts again: the next `write` puts torque back on."""
        self._off.clear()

    @property
    def holds(self) -> bool:
        """Whether any part is still written, so that its joints hold."""
        return len(self._off) < len(self._parts)

    def require_relax(self) -> None:
        """Raise where a part cannot take torque off.

        Raises:
            NotSupported: naming the part.
        """
        for name, part in self._parts.items():
            if type(part).relax is Hardware.relax:
                raise NotSupported(f"control.stop: relax: hardware {name!r} cannot take torque off; use hold or a pose")

    def reset_faults(self) -> None:
        """Clear the faults that parts have latched."""
        self._each(lambda part: part.reset_faults())

    def counters(self) -> dict[str, dict[str, int]]:
        """What the parts count, per part; those that count nothing left out."""
        return {name: counts for name, part in self._parts.items() if (counts := dict(part.counters()))}

    def read_signals(self) -> Vector:
        """The signals of all parts one after the other, shape (S,); the array is reused by the next call."""
        begin = 0
        for part in self._parts.values():
            for index, signal in enumerate(part.signals):
                part.read_signal(index, self._signal_values[begin : begin + signal.size])
                begin += signal.size
        return self._signal_values

    def advance(self, step_ns: int) -> None:
        """Advance those that are simulated."""
        for part in self._simulated:
            part.advance(step_ns)

    def reset_episode(self, episode: EpisodeSetup) -> None:
        """Set up simulated scenes again.

        Raises:
            NotSupported: where no part is simulated.
        """
        if not self._simulated:
            raise NotSupported("only a simulation can be set up again")
        for part in self._simulated:
            part.reset(episode)

    def success(self) -> bool | None:
        """Whether the scene's task is done; None where there is none."""
        return self._simulated[0].success() if self._simulated else None

    def _each(self, act: Callable[[Hardware], Any], but: Collection[str] = ()) -> Sequence[Any]:
        parts = [(name, part) for name, part in self._parts.items() if name not in but]
        if self._pool is None:
            return [_named(name, partial(act, part)) for name, part in parts]
        futures = [(name, self._pool.submit(act, part)) for name, part in parts]
        wait([future for _, future in futures])  # also where one fails: no part is called twice at once
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
