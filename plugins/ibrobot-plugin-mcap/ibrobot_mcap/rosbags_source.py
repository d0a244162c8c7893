"""Bags of others, as the rosbags library reads them."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import override

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, ReaderError

from ibrobot_core.errors import RecorderError
from ibrobot_mcap.sources import Raw, Source


class RosbagsSource(Source):
    """What the rosbags library reads: sqlite3, compressed files and messages."""

    def __init__(self, path: Path) -> None:
        try:
            self._reader = Reader(path)
            self._reader.open()
        except (ReaderError, OSError) as error:
            raise RecorderError(f"{path}: {error}") from error
        self._path = path
        reader = self._reader
        self.finished = True
        self.custom = dict(self._reader.storage.metadata.custom or {})
        self.types = {connection.topic: connection.msgtype for connection in reader.connections}
        counts: dict[str, int] = {}
        for connection in reader.connections:
            counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
        self.counts = counts
        self.definitions = {c.msgtype: c.msgdef.data for c in reader.connections if c.msgdef.data}
        some = reader.message_count > 0
        self.start_ns, self.end_ns = (reader.start_time, reader.end_time - 1) if some else (0, 0)

    @override
    def messages(self, topics: Collection[str]) -> Iterator[Raw]:
        wanted: list[Connection] = [c for c in self._reader.connections if c.topic in topics]
        if not wanted:
            return
        try:
            for connection, stamp_ns, data in self._reader.messages(wanted):
                yield Raw(connection.topic, connection.msgtype, bytes(data), stamp_ns, stamp_ns)
        except (ReaderError, OSError) as error:
            raise RecorderError(f"{self._path}: {error}") from error

    @override
    def close(self) -> None:
        if self._reader.is_open:
            self._reader.close()
