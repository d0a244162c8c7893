"""Recorders: what writes an episode's messages to disk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.messages import Message


@attrs.frozen
class EpisodeStart:
    """What is known when an episode begins."""

    directory: Path
    """Where to write; does not exist yet, its parent does."""
    stamp_ns: int
    topics: Mapping[str, str]
    """Topic -> ROS 2 message type, for all that may be written."""
    metadata: Mapping[str, str]
    """Prompt, contract, fingerprint, calibration, versions: string to string."""
    any_topic: bool = False
    """Whether messages of topics that are not in `topics` are to be written too: of those that appear later."""


@attrs.frozen
class EpisodeEnd:
    """How an episode ended."""

    stamp_ns: int
    outcome: str
    """`success`, `failure`, `discarded` or `unknown`."""
    dropped: Mapping[str, int] = attrs.field(factory=dict)
    """Messages lost before they reached the recorder, per topic."""


class Recorder(ABC):
    """Writes one episode at a time. All methods are called from its own thread, unless they say otherwise."""

    min_free = 0
    """Space on the disk that it leaves free [bytes]."""

    @abstractmethod
    def begin(self, episode: EpisodeStart) -> None:
        """Open a new episode.

        Raises:
            RecorderError: e.g. the directory exists, or cannot be written.
        """

    @abstractmethod
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        """Append one message. Topics that were not announced, or that this recorder does not keep, are passed over.

        Raises:
            RecorderError: e.g. no open episode, or a full disk; what was written before stays readable.
        """

    @abstractmethod
    def end(self, episode: EpisodeEnd) -> Path | None:
        """Close the episode; returns where it is, or None when it was discarded (and nothing is left)."""

    def size_of(self, message: Message) -> int:
        """About how much a message takes on the disk [bytes]. Called from any thread, also between episodes."""
        return _size(message)

    def waiting(self) -> int:
        """What was written and is not with the disk yet [bytes]. Called from any thread."""
        return 0

    def close(self) -> None:
        """Release everything; an episode still open is ended as `unknown`. Safe to call twice."""


def _size(value: Any) -> int:
    """Of a message, or of a value in one [bytes]."""
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    if isinstance(value, bytes | str):
        return len(value)
    if isinstance(value, tuple | list):
        return sum(_size(each) for each in value)
    if attrs.has(type(value)):
        return sum(_size(getattr(value, field.name)) for field in attrs.fields(type(value)))
    return 8
