"""The motion in an episode: commanded and measured positions over time, and the error of a replay."""

from __future__ import annotations

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
    """The motion of an episode; times count from its first command."""

    joints: tuple[str, ...]
    commands: Track
    """Commanded positions."""
    states: Track | None
    """Measured positions; None if the episode has no joint states."""
    outcome: str
    seed: int | None
    """Of the scene; None if the episode does not have it."""

    @property
    def duration(self) -> float:
        """From the first to the last command [s]."""
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
        found = {joint: column[np.isfinite(column)] for joint, column in zip(self.joints, away.T, strict=True)}
        return {
            joint: {"rms_rad": float(np.sqrt(np.mean(each**2))), "max_rad": float(each.max())}
            for joint, each in found.items()
            if each.size
        }


def read_playback(reader: EpisodeReader, contract: Contract) -> Playback:
    """The motion of an episode.

    Args:
        reader: the episode.
        contract: which topics carry the commands, and of which joints.

    Raises:
        ContractError: for a command with another length than in the contract.
        RecorderError: when a topic has no commands, or the episode cannot be read.
    """
    summary = reader.summary()
    present = {topic: each for topic, each in summary.topics.items() if each.count}
    for part in contract.action_parts:
        if part.topic not in present:
            names = ", ".join(sorted(present)) or "none"
            raise RecorderError(f"{summary.path}: no message of {part.topic}, so nothing to replay; available: {names}")
    if not contract.action_parts:
        raise RecorderError(f"{summary.path}: its contract has no action, so there is nothing to replay")
    states = next((topic for topic, each in present.items() if each.type == JointState.ros_type), None)
    found: dict[str, list[tuple[int, Vector]]] = {}
    sizes = {part.topic: len(part.joints) for part in contract.action_parts}
    for item in reader.messages({*sizes, *([states] if states is not None else ())}):
        message: Any = item.message
        if isinstance(message, JointState):
            values = _positions(message, contract.action_joints)
        elif isinstance(message, Float64MultiArray) and message.data.shape == (sizes[item.topic],):
            values = message.data
        else:
            raise ContractError(
                f"{summary.path}: {item.topic} must be a {Float64MultiArray.ros_type} with {sizes[item.topic]} values, "
                f"got {message!r:.200}"
            )
        found.setdefault(item.topic, []).append((item.received_ns, values))
    first_ns = max(found[topic][0][0] for topic in sizes)
    tracks = [_track(found[topic], first_ns) for topic in sizes]
    base = tracks[0].times[tracks[0].times >= 0]
    if not base.size or not np.isfinite(np.concatenate([track.positions.ravel() for track in tracks])).all():
        raise RecorderError(f"{summary.path}: its commands do not overlap in time, or are not all finite")
    commands = Track(base - base[0], np.concatenate([track.at(base) for track in tracks], axis=1))
    return Playback(
        contract.action_joints,
        commands,
        _track(found[states], first_ns + round(base[0] * NS_PER_S)) if states in found else None,
        summary.outcome,
        _seed(summary.metadata),
    )


def _positions(message: JointState, joints: tuple[str, ...]) -> Vector:
    known = dict(zip(message.name, message.position.tolist(), strict=False))
    return np.array([known.get(joint, np.nan) for joint in joints])


def _track(samples: list[tuple[int, Vector]], first_ns: int) -> Track:
    stamps: NDArray[np.int64] = np.array([stamp for stamp, _ in samples])
    return Track((stamps - first_ns) / NS_PER_S, np.stack([values for _, values in samples]))


def _seed(metadata: Mapping[str, str]) -> int | None:
    text = metadata.get("seed", "")
    return int(text) if text.isdigit() else None
