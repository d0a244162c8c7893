"""An episode that is still being recorded, read as it reaches the disk."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import closing
from pathlib import Path
from typing import override

from ibrobot_terminal.plural import counted

from ibrobot_core.api import EpisodeReader, EpisodeSummary, Recorded, RecorderError
from ibrobot_core.app import installed_plugins

_POLL_S = 0.5
_SHARE = 20
"""Looking for new messages takes at most one of this many parts of the time; it takes longer in a longer episode."""


class GrowingEpisode(EpisodeReader):
    """Reads an episode while another process records it; `messages` ends once it has ended and everything is read.

    Args:
        path: the episode's folder.
        has_ended: waits for up to the given time [s] until the episode has ended and is whole on the disk; returns
            whether it has. May raise an error, which ends the reading.
    """

    def __init__(self, path: Path, has_ended: Callable[[float], bool]) -> None:
        self._path = path
        self._has_ended = has_ended
        self.ended = False

    def wait(self, took_s: float = 0.0) -> None:
        """Wait a while, or until the episode has ended; `took_s` is how long the last look took [s]."""
        self.ended = self.ended or self._has_ended(max(_POLL_S, _SHARE * took_s))

    @override
    def summary(self) -> EpisodeSummary:
        """What is on the disk by now."""
        with closing(installed_plugins().open_episode(self._path)) as reader:
            return reader.summary()

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        """As that of other readers, but waits for messages that are not recorded yet.

        Raises:
            RecorderError: also if a message reached the disk after later ones, so that it was passed over.
        """
        read = Counter[str]()
        for item in self.messages_since(0, topics):
            read[item.topic] += 1
            yield item
        for topic, each in self.summary().topics.items():
            if (topics is None or topic in topics) and read[topic] != each.count:
                raise RecorderError(
                    f"{self._path}: of {topic}, {counted(each.count, 'message')} came, {read[topic]} in order"
                )

    @override
    def messages_since(self, stamp_ns: int, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        whole = False
        while not whole:
            begin_s, whole = time.monotonic(), self.ended  # what is opened is whole if it has ended before
            with closing(installed_plugins().open_episode(self._path)) as reader:
                until_ns = reader.summary().end_ns  # others may follow with the same stamp
                took_s = time.monotonic() - begin_s
                for item in reader.messages_since(stamp_ns, topics):
                    if not whole and item.received_ns >= until_ns:
                        break
                    yield item
            stamp_ns = max(stamp_ns, until_ns)
            if not whole:
                self.wait(took_s)

    @override
    def digest(self) -> str:
        with closing(installed_plugins().open_episode(self._path)) as reader:
            return reader.digest()

    @override
    def close(self) -> None:
        pass
