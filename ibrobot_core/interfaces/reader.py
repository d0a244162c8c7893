"""Episode readers, which read the messages of an episode, finished or not."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import attrs

from ibrobot_core.errors import RecorderError
from ibrobot_core.messages import Message


@attrs.frozen(eq=False)
class Recorded:
    """A recorded message."""

    topic: str
    message: Message
    received_ns: int
    """Time of receipt on the recorder's side [ns]; alignment uses it as the time of receipt."""
    published_ns: int
    """Time of sending [ns]; equal to `received_ns` if the episode does not distinguish them."""


@attrs.frozen
class TopicSummary:
    """A topic of an episode."""

    type: str
    """ROS 2 message type."""
    count: int
    """Number of readable messages."""
    dropped: int = 0
    """Number of messages that the recorder lost."""
    missing: int = 0
    """Number of recorded messages that can no longer be read."""


@attrs.frozen
class EpisodeSummary:
    """Summary of an episode, available without decoding its messages."""

    path: Path
    finished: bool
    """False if its writer was killed; the counts then cover the readable part."""
    start_ns: int
    end_ns: int
    """Times of receipt of the first and the last message [ns]; both 0 for an episode without messages."""
    topics: Mapping[str, TopicSummary]
    metadata: Mapping[str, str]
    """The recorder's metadata: prompt, contract, fingerprint, calibration, versions; empty in foreign bags."""
    outcome: str = "unknown"
    """`unknown` if the episode is unfinished or lacks messages, because its end may be missing."""
    stated_outcome: str = "unknown"
    """The outcome stated by the recorder."""


_NUMBERED = re.compile(r"(.+):(\d+)")
_ROOT = Path("episodes")
"""Folder of datasets whose episodes need no path."""


@attrs.frozen
class EpisodeAddress:
    """The address of an episode."""

    path: Path
    number: int | None = None
    """Number of the episode in a dataset, from 0; None if not given."""
    given: Mapping[str, str] = attrs.field(factory=dict)
    """Metadata for an episode that has none, by the recorder's names: `contract`, `config`, `calibration`;
    `norm_mode`, the unit of its joints; `names`, JSON of feature -> names of its elements in their order."""

    @staticmethod
    def find(path: Path) -> Path:
        """The folder of a recorded episode that a short name means; any other path as it is.

        `ROOT/pick:1` is `ROOT/pick/episodes/episode_000001`, and `pick:1` is also looked up below `episodes`.
        """
        named = _NUMBERED.fullmatch(path.name)
        if named is None or path.exists():
            return path
        dataset = path.with_name(named[1])
        if path == Path(path.name) and not dataset.exists():
            dataset = _ROOT / dataset
        folder = dataset / "episodes" / f"episode_{int(named[2]):06d}"
        return folder if folder.exists() else path

    @classmethod
    def of(cls, path: Path, given: Mapping[str, str] | None = None) -> EpisodeAddress:
        """Parse the path of an episode, its short name, or `DATASET:N`.

        Raises:
            RecorderError: if it does not exist.
        """
        path = cls.find(path)
        if path.exists():
            return cls(path, None, given or {})
        named = _NUMBERED.fullmatch(path.name)
        if named is None or not (dataset := path.with_name(named[1])).exists():
            raise RecorderError(f"{path}: there is no such episode")
        return cls(dataset, int(named[2]), given or {})


class EpisodeReader(ABC):
    """Reads an episode, message by message, so that it need not fit into memory."""

    sampled: ClassVar[bool] = False
    """Whether its commands are samples of a motion, as rows of a dataset are; otherwise each holds until the next."""

    @abstractmethod
    def summary(self) -> EpisodeSummary:
        """Summarise the episode.

        Raises:
            RecorderError: if it cannot be read.
        """

    @abstractmethod
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        """Yield the messages of these topics (all if None), in the order of receipt. Can be called repeatedly.

        If the episode contains the definition of a type that core does not know, its messages are instances of a
        `messages.Message` class made from it.

        Raises:
            RecorderError: if the file is damaged; earlier messages have been delivered.
        """

    def messages_since(self, stamp_ns: int, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        """Yield the messages received at `stamp_ns` [ns] or later, as `messages` does.

        Readers override it if they can skip earlier messages without reading them.
        """
        return (item for item in self.messages(topics) if item.received_ns >= stamp_ns)

    @abstractmethod
    def digest(self) -> str:
        """Hash of all stored messages, with topics and stamps; equal for copies of an episode.

        Raises:
            RecorderError: if they cannot be read.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the files. Safe to call twice."""
