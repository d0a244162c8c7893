"""The motion in an episode: commanded and measured positions over time, and the error of a replay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    NS_PER_S,
    Contract,
    ContractError,
    EpisodeReader,
    Float64MultiArray,
    JointState,
    RecorderError,
    Vector,
)

_DENSE = 1.5
"""Longest median time between commands at the rate of control [periods]."""
_ROUNDING = 1e-6
"""Tolerance of times [periods]."""


@attrs.frozen(eq=False)
class Track:
    """Joint vectors over time."""

    times: Vector
    """[s], shape (N,), ascending."""
    positions: Vector
    """[rad], shape (N, J); NaN where a joint was not measured."""

    def at(self, times: Vector) -> Vector:
        """Positions at times, shape (len(times), J): interpolated; constant before the first and after the last."""
        return np.stack([np.interp(times, self.times, column) for column in self.positions.T], axis=1)


@attrs.frozen(eq=False)
class Playback:
    """The motion of an episode; times count from its first command of any joint."""

    joints: tuple[str, ...]
    commands: Track
    """Commanded positions at the ticks of control: the newest command by then."""
    states: Track | None
    """Measured positions; None if the episode has no joint states."""
    outcome: str
    seed: int | None
    """Seed of the scene; None if the episode does not have it."""

    @property
    def duration(self) -> float:
        """Time from the first to the last command [s]."""
        return float(self.commands.times[-1])

    def tracking(self, measured: Track) -> dict[str, dict[str, float]]:
        """How far a replay was from the recording: joint -> `rms_rad` and `max_rad`.

        Joints and times without a recorded state are left out.

        Args:
            measured: positions in the replay, over the recording's time.
        """
        if self.states is None:
            return {}
        known = (measured.times >= self.states.times[0]) & (measured.times <= self.states.times[-1])
        away = np.abs(measured.positions[known] - self.states.at(measured.times[known]))
        deviations = {joint: column[np.isfinite(column)] for joint, column in zip(self.joints, away.T, strict=True)}
        return {
            joint: {"rms_rad": float(np.sqrt(np.mean(each**2))), "max_rad": float(each.max())}
            for joint, each in deviations.items()
            if each.size
        }


def read_playback(reader: EpisodeReader, contract: Contract, period_ns: int) -> Playback:
    """The motion of an episode.

    Before its first command a joint has its recorded position or, if that is unknown, the position of the command: the
    slow approach then leads there. After its last command it keeps that to the end.

    Args:
        reader: the episode.
        contract: which topics carry the commands, and of which joints. Joints of topics without commands are left out.
        period_ns: period of the control loop that replays it [ns].

    Raises:
        ContractError: for a command with another length than in the contract.
        RecorderError: when no topic has commands, or the episode cannot be read.
    """
    summary = reader.summary()
    present = {topic: each for topic, each in summary.topics.items() if each.count}
    if not contract.action_parts:
        raise RecorderError(f"{summary.path}: its contract has no action, so there is nothing to replay")
    parts = [part for part in contract.action_parts if part.topic in present]
    if not parts:
        wanted = ", ".join(part.topic for part in contract.action_parts)
        names = ", ".join(sorted(present)) or "none"
        raise RecorderError(f"{summary.path}: no message of {wanted}, so nothing to replay; available: {names}")
    joints = tuple(joint for part in parts for joint in part.joints)
    states = next((topic for topic, each in present.items() if each.type == JointState.ros_type), None)
    values = _read(reader, {part.topic: len(part.joints) for part in parts}, states, joints)
    first_ns = min(values[part.topic][0][0] for part in parts)
    sent = [_track(values[part.topic], first_ns) for part in parts]
    if not np.isfinite(np.concatenate([track.positions.ravel() for track in sent])).all():
        raise RecorderError(f"{summary.path}: its commands are not all finite")
    measured = _track(values[states], first_ns) if states in values else None
    count = math.ceil(max(track.times[-1] for track in sent) * NS_PER_S / period_ns - _ROUNDING) + 1
    held = np.concatenate([_at_ticks(track, count, period_ns, sampled=reader.sampled) for track in sent], axis=1)
    if measured is not None:
        held = np.where(np.isnan(held), measured.at(np.zeros(1)), held)
    first = np.concatenate([track.positions[0] for track in sent])
    held = np.where(np.isnan(held), first, held)
    commands = Track(np.arange(count) * (period_ns / NS_PER_S), held)
    seed = summary.metadata.get("seed", "")
    return Playback(joints, commands, measured, summary.outcome, int(seed) if seed.isdigit() else None)


def _read(
    reader: EpisodeReader, sizes: Mapping[str, int], states: str | None, joints: tuple[str, ...]
) -> dict[str, list[tuple[int, Vector]]]:
    """Topic -> receipt [ns] and positions [rad] of its messages; `sizes` has those of the topics of commands."""
    by_topic: dict[str, list[tuple[int, Vector]]] = {}
    for item in reader.messages({*sizes, *([states] if states is not None else ())}):
        message: Any = item.message
        if isinstance(message, JointState):
            known = dict(zip(message.name, message.position.tolist(), strict=False))
            values = np.array([known.get(joint, np.nan) for joint in joints])
        elif isinstance(message, Float64MultiArray) and message.data.shape == (sizes[item.topic],):
            values = message.data
        else:
            raise ContractError(
                f"{reader.summary().path}: {item.topic} must be a {Float64MultiArray.ros_type} with "
                f"{sizes[item.topic]} values, got {message!r:.200}"
            )
        by_topic.setdefault(item.topic, []).append((item.received_ns, values))
    return by_topic


def _at_ticks(track: Track, count: int, period_ns: int, *, sampled: bool) -> Vector:
    """Commands at each of `count` ticks [rad], shape (count, J): the newest by then, NaN before the first.

    Commands at the rate of control belong to the tick nearest to their receipt, which varies by less than a period.
    Samples of a motion are interpolated.
    """
    ticks: NDArray[np.float64] = track.times * NS_PER_S / period_ns
    every: NDArray[np.float64] = np.arange(count, dtype=np.float64)
    if sampled:
        return np.where((every < ticks[0] - _ROUNDING)[:, None], np.nan, track.at(every * (period_ns / NS_PER_S)))
    if len(ticks) > 1 and np.median(np.diff(ticks)) <= _DENSE:
        ticks = np.round(ticks)
    newest = np.searchsorted(ticks - _ROUNDING, every, side="right") - 1
    return np.where((newest < 0)[:, None], np.nan, track.positions[newest])


def _track(samples: list[tuple[int, Vector]], first_ns: int) -> Track:
    stamps: NDArray[np.int64] = np.array([stamp for stamp, _ in samples])
    return Track((stamps - first_ns) / NS_PER_S, np.stack([values for _, values in samples]))
