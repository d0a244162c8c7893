"""One MCAP file of an episode as it is written."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, cast

import attrs
from ibrobot_ros2 import definition, type_hash
from mcap.writer import CompressionType, Writer

from ibrobot_mcap.metadata import RECORD, RECORD_KEY, Counted, Topic, dump, offered_qos
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.scan import REPEATED

LIBRARY = f"ibrobot-plugin-mcap {version('ibrobot-plugin-mcap')}"
_COMPRESSION = {"none": CompressionType.NONE, "lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD}
# Not everywhere is there a sync that leaves the file's times alone.
_sync = getattr(os, "fdatasync", os.fsync)
_PIECE = 256 * 1024
"""What is given to the disk at a time [bytes]."""


def _to_disk(descriptor: int, offset: int) -> None:
    """Have the piece at `offset` written out now.

    What the kernel gathers it writes in large requests, during which even processes of real-time priority wait: the
    control loop was 2 ms late then, and a tenth of that with this.
    """
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(descriptor, offset, _PIECE, os.POSIX_FADV_DONTNEED)


@attrs.frozen
class Item:
    """A message as it goes into a file."""

    topic: Topic
    data: memoryview
    """CDR."""
    received_ns: int
    published_ns: int


class _Output:
    """A file without a buffer of its own: what was written is with the operating system, and survives the process."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self.size = 0
        self._handed = 0
        """Up to here the disk was given what is in the file [bytes]; whole pieces only."""
        self._closed = False
        self._aside: threading.Thread | None = None
        self._failure: OSError | None = None

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._descriptor, rest)
            rest = rest[written:]
            self.size += written
        while self._handed + _PIECE <= self.size:
            _to_disk(self._descriptor, self._handed)
            self._handed += _PIECE
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        """Put what is in the file onto the disk.

        Raises:
            OSError: when the disk refuses it now, or refused it aside.
        """
        self._wait_aside()
        _sync(self._descriptor)

    def sync_aside(self) -> None:
        """Begin a sync in a thread: a busy disk takes seconds for it, in which messages must be written.

        Raises:
            OSError: when an earlier one failed.
        """
        if self._aside is not None and self._aside.is_alive():
            return
        self._wait_aside()
        self._aside = threading.Thread(target=self._sync_or_fail, args=(os.dup(self._descriptor),), daemon=True)
        self._aside.start()

    def _sync_or_fail(self, descriptor: int) -> None:
        try:
            _sync(descriptor)
        except OSError as error:
            self._failure = error
        finally:
            os.close(descriptor)

    def _wait_aside(self) -> None:
        if self._aside is not None:
            self._aside.join()
            self._aside = None
        if self._failure is not None:
            raise self._failure

    def cut(self, size: int) -> None:
        os.ftruncate(self._descriptor, size)
        os.lseek(self._descriptor, size, os.SEEK_SET)
        self.size = size
        self._handed = min(self._handed, size - size % _PIECE)

    def close(self) -> None:
        if self._aside is not None:
            self._aside.join()
        if not self._closed:
            self._closed = True
            os.close(self._descriptor)


class BagFile:
    """Writes one file: profile `ros2`, `ros2msg` schemas, CDR messages in chunks.

    Every method that writes leaves a file of whole records when it fails.

    Raises:
        OSError: when it cannot be made or written; the same goes for its methods.
    """

    def __init__(self, path: Path, options: McapOptions, facts: Mapping[str, Any]) -> None:
        self.path = path
        self.counted = Counted()
        self.counts: dict[Topic, int] = {}
        self._channels: dict[Topic, int] = {}
        self._schemas: dict[str, int] = {}
        self._chunk_start_ns: int | None = None
        self._output = _Output(path)
        self._writer: Any = Writer(
            cast(IO[Any], self._output), chunk_size=options.chunk_size, compression=_COMPRESSION[options.compression]
        )
        with _whole_records(self._output):
            self._writer.start("ros2", LIBRARY)
            self._add_facts(facts)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._output.size

    def chunk_age_ns(self, received_ns: int) -> int:
        """Time from the first message that is not in the file yet to `received_ns` [ns]; 0 without one."""
        return 0 if self._chunk_start_ns is None else received_ns - self._chunk_start_ns

    @property
    def waiting(self) -> bool:
        """Whether there are messages that are not in the file yet."""
        return self._chunk_start_ns is not None

    def announce(self, topic: Topic) -> None:
        """Let the file have `topic`, with or without messages."""
        if topic in self._channels:
            return
        if topic.type not in self._schemas:
            text = definition(topic.type).encode()
            self._schemas[topic.type] = self._writer.register_schema(topic.type, "ros2msg", text)
        metadata = {
            "offered_qos_profiles": dump(offered_qos(topic.latched)),
            "topic_type_hash": type_hash(topic.type),
        }
        with _whole_records(self._output):
            number = self._writer.register_channel(topic.name, "cdr", self._schemas[topic.type], metadata)
        self._channels[topic] = number
        self.counts.setdefault(topic, 0)

    def add(self, item: Item) -> None:
        """Add a message; it is in the file when its chunk is full, or at the next `flush`."""
        self.announce(item.topic)
        size = self.size
        with _whole_records(self._output):
            self._writer.add_message(
                self._channels[item.topic], item.received_ns, cast(bytes, item.data), item.published_ns,
                self.counts[item.topic] + 1,
            )  # fmt: skip
        self.counts[item.topic] += 1
        self.counted.add(item.received_ns)
        if self.size != size:
            self._chunk_start_ns = None  # its chunk was full
        elif self._chunk_start_ns is None:
            self._chunk_start_ns = item.received_ns

    def add_repeated(self, items: list[Item]) -> None:
        """Add copies of messages of the file before, in a chunk of their own that says so."""
        with _whole_records(self._output):
            self._writer.add_metadata(REPEATED, {"messages": str(len(items))})
        for item in items:
            self.add(item)
        self.flush()

    def flush(self) -> None:
        """Put everything into the file."""
        with _whole_records(self._output):
            self._writer.flush()
        self._chunk_start_ns = None

    def sync_aside(self) -> None:
        """Begin to put what is in the file onto the disk; see `_Output.sync_aside`."""
        self._output.sync_aside()

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Write the index, and close."""
        with _whole_records(self._output):
            self._writer.flush()
            self._add_facts(facts)
            self._writer.finish()
        self._output.sync()
        self._output.close()

    def abandon(self) -> None:
        """Close as it is. Safe to call twice, and after `finish`."""
        self._output.close()

    def _add_facts(self, facts: Mapping[str, Any]) -> None:
        self._writer.add_metadata(RECORD, {RECORD_KEY: dump(dict(facts))})


@contextmanager
def _whole_records(output: _Output) -> Iterator[None]:
    """What fails within leaves no part of a record behind."""
    size = output.size
    try:
        yield
    except BaseException:
        output.cut(size)
        raise
