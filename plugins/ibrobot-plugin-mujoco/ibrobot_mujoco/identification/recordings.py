"""Commands and measured positions of the recordings of an arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import (
    NS_PER_S,
    Contract,
    EpisodeAddress,
    EpisodeReader,
    Float64MultiArray,
    JointState,
    RecorderError,
    Robot,
    Vector,
)
from ibrobot_core.app import installed_plugins

SHORTEST_S = 2.0
"""A recording that is shorter tells nothing of an arm."""
_FAR_RAD = 10.0
"""Beyond it, positions are not radians."""
_HISTORY_S = 10.0
"""Commands that a part of a recording has from before it [s]."""
_LONGEST_GAP_S = 0.5
"""A longer pause of the measurements divides a recording."""


@attrs.frozen(eq=False)
class Recording:
    """A stretch of a recording without gaps. Times count from its first measurement [s]."""

    name: str
    command_times: Vector
    """Shape (N,), ascending; the first is at or before 0."""
    commands: Vector
    """[rad], shape (N, J); each holds until the next."""
    times: Vector
    """Of the measurements, shape (M,), ascending."""
    measured: Vector
    """[rad], shape (M, J)."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])

    def cut(self, begin: float, end: float) -> Recording:
        """The part between two times [s], with the commands before it, on which the state of the gears depends."""
        kept = (self.times >= begin) & (self.times < end)
        start = self.times[kept][0]
        first = max(0, int(np.searchsorted(self.command_times, start - _HISTORY_S, side="right")) - 1)
        given = slice(first, int(np.searchsorted(self.command_times, end)))
        return attrs.evolve(
            self, name=f"{self.name} from {start:.0f} s", command_times=self.command_times[given] - start,
            commands=self.commands[given], times=self.times[kept] - start, measured=self.measured[kept],
        )  # fmt: skip


def find_recordings(paths: Sequence[Path]) -> list[Path]:
    """The episodes of all paths: recordings, folders of them, and episodes of datasets (`DATASET:N`).

    Raises:
        RecorderError: if a path does not exist.
    """
    listed: list[Path] = []
    for path in paths:
        episode = EpisodeAddress.find(path)
        if not episode.exists() and ":" not in episode.name:
            raise RecorderError(f"{path}: there is no such recording")
        below = sorted(episode.glob("episodes/episode_*")) or sorted(episode.glob("episode_*"))
        listed += below or [episode]
    return list(dict.fromkeys(listed))


def read_recordings(path: Path, robot: Robot, given: Mapping[str, str] | None = None) -> list[Recording]:
    """The stretches of a recording that are long enough.

    Args:
        path: the episode.
        robot: whose joints are read.
        given: what the episode does not say; see `EpisodeAddress.given`.

    Raises:
        RecorderError: if it cannot be read, or lacks commands or positions of a joint.
    """
    with closing(installed_plugins().open_episode(path, given)) as reader:
        return recordings_of(reader, robot)


def recordings_of(reader: EpisodeReader, robot: Robot) -> list[Recording]:
    """The stretches of an open recording; see `read_recordings`.

    Raises:
        RecorderError: likewise.
    """
    summary = reader.summary()
    contract = Contract.of_episode(summary.metadata)
    if contract is None:
        raise RecorderError(
            f"{summary.path}: has no contract, so it is unknown which topics are commands; ibrobot records one with "
            "every episode, and `ibrobot contract init` drafts one for foreign bags"
        )
    read = _Reading(summary.path, robot.joint_names, contract)
    read.take_all(reader)
    return read.recordings()


class _Reading:
    def __init__(self, path: Path, joints: tuple[str, ...], contract: Contract) -> None:
        self._path, self._joints = path, joints
        self._parts = {part.topic: part for part in contract.action_parts}
        commanded = {joint for part in contract.action_parts for joint in part.joints}
        if missing := [joint for joint in joints if joint not in commanded]:
            raise RecorderError(
                f"{path}: its contract has no command of {missing[0]!r}; it has: {', '.join(sorted(commanded))}. "
                "--robot names the robot YAML of the arm that was recorded"
            )
        self._measured: dict[str, float] = {}
        self._stamp_ns = 0
        self._commanded: dict[str, float] = {}
        self._states: list[tuple[int, list[float]]] = []
        self._commands: list[tuple[int, list[float]]] = []
        self._of_tick: set[str] = set()
        """Topics of the commands of the present tick."""

    def take_all(self, reader: EpisodeReader) -> None:
        there = {topic: each for topic, each in reader.summary().topics.items() if each.count}
        states = {topic for topic, each in there.items() if each.type == JointState.ros_type}
        for item in reader.messages({*states, *(self._parts.keys() & there.keys())}):
            if item.topic in self._parts:
                self._take_command(item.topic, item.message, item.received_ns)
            elif isinstance(item.message, JointState):
                self._take_state(item.message, item.received_ns)

    def _take_state(self, message: JointState, received_ns: int) -> None:
        self._measured |= dict(zip(message.name, message.position.tolist(), strict=False))
        self._stamp_ns = message.header.stamp_ns or received_ns
        if all(joint in self._measured for joint in self._joints):
            self._states.append((self._stamp_ns, [self._measured[joint] for joint in self._joints]))

    def _take_command(self, topic: str, message: Any, received_ns: int) -> None:
        part = self._parts[topic]
        if isinstance(message, Float64MultiArray):
            values = message.data.tolist()
        elif isinstance(message, JointState):
            known = dict(zip(message.name, message.position.tolist(), strict=False))
            values = [known.get(joint, float("nan")) for joint in part.joints]
        else:
            raise RecorderError(f"{self._path}: {topic} has a {type(message).ros_type}, not commands of joints")
        if len(values) != len(part.joints):
            raise RecorderError(f"{self._path}: a command on {topic} has {len(values)} values, not {len(part.joints)}")
        self._commanded |= dict(zip(part.joints, values, strict=True))
        if not all(joint in self._commanded for joint in self._joints):
            return
        row = [self._commanded[joint] for joint in self._joints]
        # A control loop publishes its commands with the state of the same tick, whose stamp is exact.
        stamp_ns = self._stamp_ns or received_ns
        if self._commands and self._commands[-1][0] >= stamp_ns:
            if topic in self._of_tick:
                stamp_ns = received_ns  # commands without measurements between them
            else:
                self._commands[-1] = (self._commands[-1][0], row)
                self._of_tick.add(topic)
                return
        self._of_tick = {topic}
        self._commands.append((stamp_ns, row))

    def recordings(self) -> list[Recording]:
        for what, rows in (("positions", self._states), ("commands", self._commands)):
            if len(rows) < 2:
                raise RecorderError(f"{self._path}: has no {what} of {', '.join(self._joints)}")
        states, commands = _ordered(self._states), _ordered(self._commands)
        for what, (_, values) in (("positions", states), ("commands", commands)):
            if not np.isfinite(values).all():
                raise RecorderError(f"{self._path}: its {what} are not all finite")
            if np.abs(values).max() > _FAR_RAD:
                raise RecorderError(
                    f"{self._path}: its {what} reach {np.abs(values).max():.4g}, which are no radians; state the unit "
                    "with --norm-mode"
                )
        times_ns = states[0]
        edges = [0, *(1 + np.flatnonzero(np.diff(times_ns) > _LONGEST_GAP_S * NS_PER_S)), len(times_ns)]
        stretches = [
            made
            for begin, end in pairwise(edges)
            if (made := self._stretch(states, commands, int(begin), int(end))) is not None
        ]
        if not stretches:
            raise RecorderError(f"{self._path}: no stretch of {SHORTEST_S:g} s has commands and measurements")
        return stretches

    def _stretch(
        self, states: tuple[Any, Vector], commands: tuple[Any, Vector], begin: int, end: int
    ) -> Recording | None:
        """A stretch without gaps, from the first measurement after the first command; None if it is too short."""
        times_ns, measured = states[0][begin:end], states[1][begin:end]
        kept = times_ns >= commands[0][0]
        times_ns, measured = times_ns[kept], measured[kept]
        if len(times_ns) < 2:
            return None
        start = times_ns[0]
        times = (times_ns - start) / NS_PER_S
        if times[-1] < SHORTEST_S:
            return None
        first = max(0, int(np.searchsorted(commands[0], start, side="right")) - 1)
        last = int(np.searchsorted(commands[0], times_ns[-1], side="right"))
        name = self._path.name if begin == 0 else f"{self._path.name} from row {begin}"
        return Recording(name, (commands[0][first:last] - start) / NS_PER_S, commands[1][first:last], times, measured)


def _ordered(rows: list[tuple[int, list[float]]]) -> tuple[Any, Vector]:
    """Times [ns], strictly ascending, and values."""
    times = np.array([time for time, _ in rows], np.int64)
    values = np.array([each for _, each in rows], np.float64)
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    last = np.append(np.diff(times) > 0, True)  # of equal stamps, the last
    return times[last], values[last]
