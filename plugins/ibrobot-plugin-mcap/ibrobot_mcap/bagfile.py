"""Writes one MCAP file of an episode."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, cast

import attrs
from ibrobot_ros2 import definition, is_idl
from mcap.writer import CompressionType, Writer

from ibrobot_mcap.metadata import RECORD, RECORD_KEY, Counted, Topic, dump, offered_qos
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.output import Output
from ibrobot_mcap.scan import REPEATED

LIBRARY = f"ibrobot-plugin-mcap {version('ibrobot-plugin-mcap')}"
_COMPRESSION = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}


@cache
def _qos_text(latched: bool) -> str:
    """The QoS profiles of a topic's publishers, as YAML."""
    return dump(offered_qos(latched))


@attrs.frozen
class Item:
    """A message to be written to a file."""

    topic: Topic
    data: memoryview
    """CDR."""
    received_ns: int
    published_ns: int


class BagFile:
    """Writes one file: profile `ros2`, `ros2msg` schemas, CDR messages in chunks.

    If a write fails, the file still contains only complete records.

    Raises:
        OSError: if the file cannot be created or written, as in all methods.
    """

    def __init__(self, path: Path, options: McapOptions, info: Mapping[str, Any]) -> None:
        self.path = path
        self.counted = Counted()
        self.counts: dict[Topic, int] = {}
        self._channels: dict[Topic, int] = {}
        self._schemas: dict[str, int] = {}
        self._chunk_start_ns: int | None = None
        self._output = Output(path)
        self._writer: Any = Writer(
            cast(IO[Any], self._output), chunk_size=options.chunk_size, compression=_COMPRESSION[options.compression]
        )
        try:
            with _whole_records(self._output):
                self._writer.start("ros2", LIBRARY)
                self._add_info(info)
        except BaseException:
            self._output.close()
            raise

    @property
    def size(self) -> int:
        """Size of the file [bytes]."""
        return self._output.size

    def chunk_age_ns(self, received_ns: int) -> int:
        """Time from the first unwritten message to `received_ns` [ns]; 0 if there is none."""
        return 0 if self._chunk_start_ns is None else received_ns - self._chunk_start_ns

    @property
    def waiting(self) -> bool:
        """Whether there are unwritten messages."""
        return self._chunk_start_ns is not None

    def announce(self, topic: Topic) -> None:
        """Add `topic` to the file, with or without messages."""
        if topic in self._channels:
            return
        if topic.type not in self._schemas:
            text = topic.definition or definition(topic.type)
            encoding = "ros2idl" if is_idl(text) else "ros2msg"
            self._schemas[topic.type] = self._writer.register_schema(topic.type, encoding, text.encode())
        metadata = {"offered_qos_profiles": _qos_text(topic.latched), "topic_type_hash": topic.type_hash()}
        with _whole_records(self._output):
            number = self._writer.register_channel(topic.name, "cdr", self._schemas[topic.type], metadata)
        self._channels[topic] = number
        self.counts.setdefault(topic, 0)

    def add(self, item: Item) -> None:
        """Add a message; it is written when its chunk is full, or at the next `flush`."""
        self.announce(item.topic)
        size = self.size
        with _whole_records(self._output):
            self._writer.add_message(
                self._channels[item.topic],
                item.received_ns,
                cast(bytes, item.data),
                item.published_ns,
                self.counts[item.topic] + 1,
            )
        self.counts[item.topic] += 1
        self.counted.add(item.received_ns)
        if self.size != size:
            self._chunk_start_ns = None  # its chunk was full
        elif self._chunk_start_ns is None:
            self._chunk_start_ns = item.received_ns

    def add_repeated(self, items: list[Item]) -> None:
        """Add copies of messages from the previous file, in a separate chunk that is marked as such."""
        with _whole_records(self._output):
            self._writer.add_metadata(REPEATED, {"messages": str(len(items))})
        for item in items:
            self.add(item)
        self.flush()

    def flush(self) -> None:
        """Write all messages to the file."""
        with _whole_records(self._output):
            self._writer.flush()
        self._chunk_start_ns = None

    def sync_aside(self) -> None:
        """Begin to sync the file to the disk; see `Output.sync_aside`."""
        self._output.sync_aside()

    def finish(self, info: Mapping[str, Any]) -> None:
        """Write the index, and close."""
        with _whole_records(self._output):
            self._writer.flush()
            self._add_info(info)
            self._writer.finish()
        self._output.sync()
        self._output.close()

    def abandon(self) -> None:
        """Close without finishing. Safe to call twice, and after `finish`."""
        self._output.close()

    def _add_info(self, info: Mapping[str, Any]) -> None:
        self._writer.add_metadata(RECORD, {RECORD_KEY: dump(dict(info))})


@contextmanager
def _whole_records(output: Output) -> Iterator[None]:
    """A context that removes incomplete records if an error occurs."""
    size = output.size
    try:
        yield
        if output.size != size:
            output.hand_over()
    except BaseException:
        output.cut(size)
        raise
