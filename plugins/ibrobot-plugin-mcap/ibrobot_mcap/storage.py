"""Writes an episode's folder: consecutive files, and `metadata.yaml` at the end."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from ibrobot_core.api import NS_PER_S, EpisodeStart, RecorderError, ns
from ibrobot_mcap.bagfile import BagFile, Item
from ibrobot_mcap.metadata import DROPPED, FAULTS, OUTCOME, STATED, Counted, Topic, information, write_metadata
from ibrobot_mcap.options import MIB, McapOptions

_LOOK_SIZE = 16 * MIB
"""Number of written bytes between checks of the free space."""


class Storage:
    """Writes an episode. Used by one thread at a time.

    A chunk is passed to the operating system when it is full or `chunk_period_s` old, so that it survives the end of
    the process, and synced to the disk every `sync_period_s`, so that it survives a power failure.

    Raises:
        RecorderError: if the folder exists or cannot be written, or the disk has too little space.
    """

    def __init__(self, episode: EpisodeStart, options: McapOptions) -> None:
        self._episode = episode
        self._options = options
        self._directory = episode.directory
        self._period_ns = ns(options.chunk_period_s)
        self._files: dict[str, Counted] = {}
        self._inodes: dict[Path, os.stat_result] = {}
        """The folder and the files as they were created."""
        self._topics: dict[Topic, int] = {}
        self._latched: dict[str, Item] = {}
        self._looked_at = 0
        """Size of the present file at the last check of the free space [bytes]."""
        self._synced_s = time.monotonic()
        self._waits_since_s: float | None = None
        """Wall time at which the oldest unwritten message arrived [s]."""
        self._broken: RecorderError | None = None
        _check_text(episode)
        self._check_space(self._directory.parent)
        try:
            self._directory.mkdir()
        except OSError as error:
            raise RecorderError(f"cannot record into {self._directory}: {error.strerror}") from error
        try:
            self._inodes[self._directory] = self._directory.stat()
            self._file = self._open_file()
        except OSError as error:
            shutil.rmtree(self._directory)
            raise RecorderError(f"cannot record into {self._directory}: {error.strerror}") from error

    def announce(self, topic: Topic) -> None:
        """Add `topic` to the episode, with or without messages."""
        self._topics.setdefault(topic, 0)

    def write(self, item: Item) -> None:
        """Add a message.

        Raises:
            RecorderError: if the write fails, or less than `min_free` is left.
        """
        try:
            if self._is_full(item):
                self._close_file()
                self._file = self._open_file()
                self._repeat(item.received_ns)
            if self._file.chunk_age_ns(item.received_ns) >= self._period_ns:
                self._flush()
            if self._file.size - self._looked_at >= _LOOK_SIZE:
                self._check_space(self._directory)
                self._looked_at = self._file.size
            self._file.add(item)
        except OSError as error:
            self._fail(error)
        if item.topic.latched:
            self._latched[item.topic.name] = item
        self._topics[item.topic] = self._topics.get(item.topic, 0) + 1
        if not self._file.waiting:
            self._waits_since_s = None
        elif self._waits_since_s is None:
            self._waits_since_s = time.monotonic()

    def due_in_s(self) -> float | None:
        """Wall time until `flush_due` must be called [s]; None if there are no unwritten messages."""
        if self._waits_since_s is None:
            return None
        return max(0.0, self._waits_since_s + self._options.chunk_period_s - time.monotonic())

    def flush_due(self) -> None:
        """Write messages that have waited for `chunk_period_s` of wall time, even if no more arrive.

        Raises:
            RecorderError: if the write fails.
        """
        if self.due_in_s() != 0.0:
            return
        try:
            self._flush()
            self._check_space(self._directory)
            period_s = self._options.sync_period_s
            if period_s is not None and time.monotonic() - self._synced_s >= period_s:
                self._check_place()
                self._file.sync_aside()
                self._synced_s = time.monotonic()
        except OSError as error:
            self._fail(error)

    def finish(
        self, outcome: str, dropped: Mapping[str, int], faults: Sequence[str] = (), *, cut: bool = False
    ) -> None:
        """Finish the episode: write the files' indices, then `metadata.yaml`, which marks it as complete.

        Args:
            outcome: how the episode ended.
            dropped: topic -> number of lost messages.
            faults: the faults and emergency stops during the episode.
            cut: whether its end was lost, so that its outcome is unknown.

        Raises:
            RecorderError: if the write fails; the episode then remains unfinished but readable. Also if its folder or
                one of its files was moved, replaced or removed.
        """
        if self._broken is not None:
            self._file.abandon()
            raise self._broken
        lost = json.dumps(dict(sorted(dropped.items())))
        custom = {**self._episode.metadata, OUTCOME: "unknown" if cut else outcome, DROPPED: lost}
        custom |= {STATED: outcome} if cut and outcome != "unknown" else {}
        custom |= {FAULTS: json.dumps(list(faults))} if faults else {}
        try:
            self._check_place()
            self._close_file(custom)
            write_metadata(self._directory, self._information(custom))
        except OSError as error:
            self._file.abandon()
            self._fail(error)
        except RecorderError:
            self._file.abandon()
            raise

    def discard(self) -> None:
        """Remove the episode.

        Raises:
            RecorderError: if it cannot be removed, or was moved or replaced.
        """
        self._file.abandon()
        self._check_place()
        try:
            shutil.rmtree(self._directory)
        except OSError as error:
            raise RecorderError(f"{self._directory}: cannot be removed: {error.strerror}") from error

    def _open_file(self) -> BagFile:
        name = os.fsencode(self._directory.name).decode("utf-8", "replace")  # `metadata.yaml` lists it
        path = self._directory / f"{name}_{len(self._files)}.mcap"
        file = BagFile(path, self._options, self._information(self._episode.metadata))
        self._files[path.name] = file.counted
        self._inodes[path] = path.stat()
        self._looked_at = 0
        return file

    def _close_file(self, custom: Mapping[str, str] | None = None) -> None:
        for topic in self._topics:
            self._file.announce(topic)
        self._file.finish(self._information(self._episode.metadata if custom is None else custom))
        self._waits_since_s = None

    def _is_full(self, item: Item) -> bool:
        size, duration = self._options.split_size, self._options.split_duration
        if self._file.counted.count == 0:
            return False
        full = size is not None and self._file.size >= size
        return full or (duration is not None and item.received_ns - self._file.counted.start_ns >= duration * NS_PER_S)

    def _repeat(self, received_ns: int) -> None:
        """Repeat the latched messages, so that a file can be played without the previous one."""
        items = [Item(i.topic, i.data, received_ns, i.published_ns) for i in self._latched.values()]
        if items:
            self._file.add_repeated(items)
        for item in items:
            self._topics[item.topic] += 1

    def _information(self, custom: Mapping[str, str]) -> dict[str, object]:
        return information(self._files, self._topics, custom, self._episode.stamp_ns)

    def _flush(self) -> None:
        self._file.flush()
        self._waits_since_s = None

    def _check_place(self) -> None:
        """Check that the folder and all files are still at their paths: other programs may ignore the ownership."""
        for path, created in self._inodes.items():
            try:
                there = os.path.samestat(created, path.stat())
            except OSError:
                there = False
            if not there:
                self._broken = RecorderError(
                    f"{path}: was moved, replaced or removed while it was being recorded; what is there is not the "
                    "recording"
                )
                raise self._broken

    def _check_space(self, path: os.PathLike[str]) -> None:
        try:
            disk = os.statvfs(path)
        except OSError as error:
            raise RecorderError(f"cannot record into {self._directory}: {error.strerror}") from error
        free = disk.f_bavail * disk.f_frsize
        if free < self._options.min_free:
            raise RecorderError(
                f"{self._directory}: its disk has {free // MIB} MiB left, recording needs "
                f"{self._options.min_free // MIB} MiB (min_free); make room or record elsewhere (recording.root)"
            )

    def _fail(self, error: OSError) -> NoReturn:
        self._broken = RecorderError(
            f"{self._directory}: cannot be written: {error.strerror}; it stays unfinished, with what was written before"
        )
        raise self._broken from error


def _check_text(episode: EpisodeStart) -> None:
    """Check that the metadata is valid Unicode."""
    for key, value in episode.metadata.items():
        try:
            value.encode()
        except UnicodeEncodeError as error:
            place = f"U+{ord(value[error.start]):04X} at character {error.start + 1}"
            raise RecorderError(f"{episode.directory}: {key} has half of a character, {place}") from None
