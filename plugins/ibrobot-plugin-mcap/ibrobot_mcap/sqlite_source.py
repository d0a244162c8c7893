"""Messages of sqlite3 files, written by rosbag2's storage plugin `sqlite3`."""

from __future__ import annotations

import heapq
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any, override
from urllib.parse import quote

from ibrobot_core.api import RecorderError
from ibrobot_mcap.damage import reading
from ibrobot_mcap.sources import CDR, Raw, Source


class SqliteSource(Source):
    """The sqlite3 files of a bag, with the tables `topics`, `messages` and, in newer ones, `message_definitions`."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._files: list[tuple[Path, sqlite3.Connection, dict[int, str]]] = []
        self.finished, self.custom = True, {}
        self.types, self.definitions = {}, {}
        latched: set[str] = set()
        counts: Counter[str] = Counter()
        spans: list[tuple[int, int]] = []
        try:
            for path in paths:
                with reading(path):
                    self._open(path, latched, counts, spans)
        except BaseException:
            self.close()
            raise
        self.counts = {topic: counts[topic] for topic in self.types}
        self.latched = frozenset(latched)
        self.start_ns = min((start for start, _ in spans), default=0)
        self.end_ns = max((end for _, end in spans), default=0)

    def _open(self, path: Path, latched: set[str], counts: Counter[str], spans: list[tuple[int, int]]) -> None:
        file = sqlite3.connect(f"file:{quote(str(path.resolve()))}?immutable=1", uri=True)
        topics: dict[int, str] = {}
        self._files.append((path, file, topics))
        columns = {row[1] for row in file.execute("PRAGMA table_info(topics)")}
        if not {"id", "name", "type", "serialization_format"} <= columns:
            raise RecorderError(f"{path}: lacks the table of topics of a rosbag2")
        qos = "offered_qos_profiles" if "offered_qos_profiles" in columns else "''"
        for key, name, type_, format_, profiles in file.execute(
            f"SELECT id, name, type, serialization_format, {qos} FROM topics ORDER BY id"
        ):
            topics[_of(int, key)] = _of(str, name)
            if format_ != CDR:
                self.encodings = {**self.encodings, name: _of(str, format_)}
            self.types = {**self.types, name: _of(str, type_)}
            if "transient_local" in _of(str, profiles):
                latched.add(name)
        if file.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            rows = file.execute("SELECT topic_type, encoded_message_definition FROM message_definitions")
            self.definitions = {**self.definitions, **{_of(str, t): _of(str, text) for t, text in rows if text}}
        _check_times(path, file)
        for key, count, start_ns, end_ns in file.execute(
            "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        ):
            counts[topics[key]] += count
            spans.append((_of(int, start_ns), _of(int, end_ns)))

    @override
    def messages(self, topics: Collection[str], since_ns: int = 0) -> Iterator[Raw]:
        streams = (self._messages(number, topics, since_ns) for number in range(len(self._files)))
        return heapq.merge(*streams, key=lambda raw: raw.received_ns)

    def _messages(self, number: int, wanted: Collection[str], since_ns: int) -> Iterator[Raw]:
        path, file, topics = self._files[number]
        with reading(path):
            query = "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? ORDER BY timestamp, id"
            rows = file.execute(query, (since_ns,))
            for key, stamp_ns, data in rows:
                topic = topics[key]
                if topic in wanted:
                    yield Raw(topic, self.types[topic], _of(bytes, data), _of(int, stamp_ns), stamp_ns)

    @override
    def close(self) -> None:
        for _, file, _ in self._files:
            file.close()


def _check_times(path: Path, file: sqlite3.Connection) -> None:
    """Compare the times of the messages with rosbag2's index, since there are no checksums."""
    if file.execute("SELECT 1 FROM sqlite_master WHERE type = 'index' AND name = 'timestamp_idx'").fetchone() is None:
        return
    by_table = file.execute("SELECT timestamp, id FROM messages NOT INDEXED ORDER BY timestamp, id")
    by_index = file.execute("SELECT timestamp, id FROM messages INDEXED BY timestamp_idx ORDER BY timestamp, id")
    if any(in_table != in_index for in_table, in_index in zip_longest(by_table, by_index)):
        raise RecorderError(f"{path}: is damaged: the times of its messages do not match its index")


def _of[T](type_: type[T], value: Any) -> T:
    """Check the type of a value, which may be wrong in a damaged file."""
    if not isinstance(value, type_):
        raise TypeError(f"a cell has {value!r:.40}, must have {type_.__name__}")
    return value
