"""Recorders, which write an episode's messages to disk."""

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
    """The beginning of an episode."""

    directory: Path
    """Folder to write, which does not exist yet; its parent does."""
    stamp_ns: int
    topics: Mapping[str, str]
    """Topic -> ROS 2 message type, for all topics that may be written."""
    metadata: Mapping[str, str]
    """Prompt, contract, fingerprint, calibration, versions, as strings."""
    any_topic: bool = False
    """Whether to write messages of topics that are not in `topics` because they appear later."""


@attrs.frozen
class EpisodeEnd:
    """The end of an episode."""

    stamp_ns: int
    outcome: str
    """`success`, `failure`, `discarded` or `unknown`."""
    dropped: Mapping[str, int] = attrs.field(factory=dict)
    """Messages lost before they reached the recorder, per topic."""
    faults: tuple[str, ...] = ()
    """The faults and emergency stops during the episode."""


class Recorder(ABC):
    """Writes one episode at a time. All methods are called from the recorder's thread, unless stated otherwise."""

    min_free = 0
    """Disk space that it leaves free [bytes]."""

    @abstractmethod
    def begin(self, episode: EpisodeStart) -> None:
        """Open a new episode.

        Raises:
            RecorderError: e.g. if the folder exists or cannot be written.
        """

    @abstractmethod
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        """Append a message. Topics that were not announced, or that this recorder does not store, are ignored.

        Raises:
            RecorderError: e.g. if no episode is open, or the disk is full; earlier messages remain readable.
        """

    @abstractmethod
    def end(self, episode: EpisodeEnd) -> Path | None:
        """Close the episode; returns its path, or None if it was discarded and removed.

        If the recorder has lost the newest message of a topic, the end is missing, and the outcome becomes `unknown`.

        Raises:
            RecorderError: if the episode could not be written to its end.
        """

    def size_of(self, message: Message) -> int:
        """Approximate size of a message on the disk [bytes]. Called from any thread, also between episodes."""
        return _size(message)

    def waiting(self) -> int:
        """Amount of data that is not yet written to the disk [bytes]. Called from any thread."""
        return 0

    def lost(self) -> Mapping[str, int]:
        """Topic -> messages of the present episode that the recorder did not write, so far. Called from any thread."""
        return {}

    def close(self) -> None:
        """Release all resources; an open episode ends as `unknown`. Safe to call twice."""


def _size(value: Any) -> int:
    """Size of a message, or of a value in a message [bytes]."""
    if attrs.has(type(value)):
        value = [getattr(value, field.name) for field in attrs.fields(type(value))]
    if isinstance(value, tuple | list):
        return sum(map(_size, value))
    if isinstance(value, bytes | str):
        return len(value)
    return int(value.nbytes) if isinstance(value, np.ndarray) else 8
