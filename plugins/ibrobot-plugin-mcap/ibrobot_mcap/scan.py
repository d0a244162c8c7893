"""Reads an MCAP file by scanning its records, which also works for unfinished files."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import attrs
import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Header, McapRecord, Metadata, Schema, Statistics
from mcap.writer import MCAP0_MAGIC as MAGIC

from ibrobot_core.api import RecorderError
from ibrobot_mcap.damage import reading

REPEATED = "ibrobot.repeated"
"""Name of the metadata record before a chunk with copies of latched messages from the previous file."""

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_INDEX = np.dtype([("received_ns", "<u8"), ("offset", "<u8")])
_INDEX_HEAD = struct.Struct("<HI")
_MESSAGE = struct.Struct("<HIQQ")
_LOOSE_SIZE = 4 << 20
"""Messages outside chunks are read in blocks of this size [bytes]."""
_LARGEST = 4 << 30
"""Maximum size of a chunk in the format's own libraries [bytes]."""
_KNOWN = range(1, Opcode.DATA_END + 1)
_PRIVATE = range(0x80, 0x100)
"""Valid opcodes."""


@attrs.frozen
class Entry:
    """A stored message."""

    channel: int
    received_ns: int
    published_ns: int
    data: memoryview


@attrs.define
class Block:
    """A chunk, or consecutive messages outside chunks."""

    offset: int
    """Offset of its records in the file; compressed if it is a chunk with compression."""
    length: int
    start_ns: int = 2**63
    end_ns: int = 0
    chunk: bool = True
    repeated: bool = False
    counts: dict[int, int] = attrs.field(factory=dict)
    """Channel -> number of messages."""
    indices: dict[int, tuple[int, int]] = attrs.field(factory=dict)
    """Channel -> offset and size of the index of its message times."""


def records(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield opcode and content of each complete record."""
    position = 0
    while position + _RECORD.size <= len(content):
        opcode, length = _RECORD.unpack_from(content, position)
        position += _RECORD.size
        if position + length > len(content):
            return
        yield opcode, content[position : position + length]
        position += length


class McapFile:
    """One file: its channels, schemas and blocks of messages, and whether its writer finished it.

    Raises:
        RecorderError: if it cannot be read or is not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, Channel] = {}
        self.schemas: dict[int, Schema] = {}
        self.blocks: list[Block] = []
        self.metadata: list[Metadata] = []
        self.stated: dict[int, int] = {}
        """Channel -> number of messages in the file's statistics; empty if it has none."""
        self.finished = False
        try:
            self._file: BinaryIO = path.open("rb")
        except OSError as error:
            raise RecorderError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            with reading(path):
                self._scan(os.fstat(self._file.fileno()).st_size)
                self._look_inside()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the file. Safe to call twice."""
        self._file.close()

    def read(self, block: Block) -> memoryview:
        """Read a block's records, decompressed and with verified checksum.

        Raises:
            RecorderError: if they are damaged.
        """
        content = memoryview(os.pread(self._file.fileno(), block.length, block.offset))
        if not block.chunk:
            return content
        try:
            _, _, size, crc, name = _CHUNK.unpack_from(content)
            start = _CHUNK.size + name
            compression = bytes(content[_CHUNK.size : start]).decode()
            content = _expand(compression, content[start + 8 :], size)
        except (struct.error, ValueError, RuntimeError, MemoryError, zstandard.ZstdError) as error:
            raise self._damaged(block, str(error)) from error
        if crc and zlib.crc32(content) != crc:
            raise self._damaged(block, "its checksum is wrong")
        return content

    def compression(self, block: Block) -> str:
        """Compression of a block, as named in the file; empty for none."""
        if not block.chunk:
            return ""
        head = os.pread(self._file.fileno(), min(block.length, _CHUNK.size + 16), block.offset)
        name = _CHUNK.unpack_from(head)[4]
        return head[_CHUNK.size : _CHUNK.size + name].decode("ascii", "replace")

    def entries(self, block: Block) -> Iterator[Entry]:
        """Yield the messages of a block in the order of writing.

        Raises:
            RecorderError: if it is damaged.
        """
        received: dict[int, list[int]] = {}
        with reading(self.path):
            for opcode, content in records(self.read(block)):
                if opcode == Opcode.MESSAGE:
                    channel, _, received_ns, published_ns = _MESSAGE.unpack_from(content)
                    if not block.start_ns <= received_ns <= block.end_ns:
                        raise self._damaged(block, f"a message of {received_ns} ns is not within its span")
                    received.setdefault(channel, []).append(received_ns)
                    yield Entry(channel, received_ns, published_ns, content[_MESSAGE.size :])
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self._note(opcode, content)
        counts = {channel: len(times) for channel, times in received.items()}
        if counts != {channel: count for channel, count in block.counts.items() if count}:
            raise self._damaged(block, "its messages do not match its index")
        with reading(self.path):
            for channel, times in received.items():
                if channel in block.indices and sorted(times) != self._indexed(block, channel):
                    topic = self.channels[channel].topic
                    raise self._damaged(block, f"the times of messages of {topic} do not match its index")

    def _indexed(self, block: Block, channel: int) -> list[int]:
        """The times of a channel's messages in the block's index [ns], ascending."""
        offset, size = block.indices[channel]
        index = np.frombuffer(os.pread(self._file.fileno(), size, offset), _INDEX)
        return np.sort(index["received_ns"]).tolist()

    def _scan(self, end: int) -> None:
        """Scan the records, reading only small ones."""
        file = self._file
        start = file.read(len(MAGIC))
        if start != MAGIC[: len(start)]:
            raise RecorderError(f"{self.path}: not an MCAP file: begins with {start.hex(' ')}")
        position = len(MAGIC)
        repeated = False
        while position + _RECORD.size <= end:
            file.seek(position)
            opcode, length = _RECORD.unpack(file.read(_RECORD.size))
            content, position = position + _RECORD.size, position + _RECORD.size + length
            if position > end or not (opcode in _KNOWN or opcode in _PRIVATE):
                return  # the last record is incomplete
            if opcode == Opcode.CHUNK:
                start_ns, end_ns = struct.unpack("<QQ", file.read(16))
                self.blocks.append(Block(content, length, start_ns, end_ns, repeated=repeated))
                repeated = False
            elif opcode == Opcode.MESSAGE:
                self._add_loose(content, length)
            elif opcode == Opcode.MESSAGE_INDEX and self.blocks:
                channel, size = _INDEX_HEAD.unpack(file.read(_INDEX_HEAD.size))
                self.blocks[-1].counts[channel] = size // _INDEX.itemsize
                self.blocks[-1].indices[channel] = content + _INDEX_HEAD.size, size
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.HEADER, Opcode.STATISTICS):
                repeated = self._note(opcode, memoryview(file.read(length))) or repeated
            if opcode == Opcode.FOOTER:
                file.seek(position)
                self.finished = file.read(len(MAGIC)) == MAGIC
                return

    def _add_loose(self, content: int, length: int) -> None:
        """Add a message outside chunks to the preceding block, if it is adjacent."""
        channel, _, received_ns, _ = _MESSAGE.unpack(self._file.read(_MESSAGE.size))
        begin = content - _RECORD.size
        last = self.blocks[-1] if self.blocks else None
        if last is None or last.chunk or last.offset + last.length != begin or last.length > _LOOSE_SIZE:
            last = Block(begin, 0, chunk=False)
            self.blocks.append(last)
        last.length = content + length - last.offset
        last.start_ns, last.end_ns = min(last.start_ns, received_ns), max(last.end_ns, received_ns)
        last.counts[channel] = last.counts.get(channel, 0) + 1

    def _note(self, opcode: int, content: memoryview) -> bool:
        """Process a record; returns whether it announces repeated messages."""
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._define(self.schemas, schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self._define(self.channels, channel.id, channel)
        elif opcode == Opcode.STATISTICS:
            self.stated = dict(Statistics.read(stream).channel_message_counts)
        elif opcode == Opcode.HEADER:
            Header.read(stream)
        else:
            metadata = Metadata.read(stream)
            self.metadata.append(metadata)
            return bool(metadata.name == REPEATED)
        return False

    def _define[T: McapRecord](self, known: dict[int, T], number: int, record: T) -> None:
        """Store a schema or channel; repetitions in a file must be equal."""
        if known.setdefault(number, record) != record:
            raise RecorderError(
                f"{self.path}: is damaged: {type(record).__name__.lower()} {number} is {record!r:.200} and "
                f"{known[number]!r:.200}"
            )

    def _damaged(self, block: Block, why: str) -> RecorderError:
        what = "chunk" if block.chunk else "block of messages"
        return RecorderError(f"{self.path}: {what} at byte {block.offset} is damaged: {why}")

    def _look_inside(self) -> None:
        """Read the chunks without an index, as in unfinished files."""
        for block in list(self.blocks):
            last_of_unfinished = not self.finished and block is self.blocks[-1]
            if block.counts and block.counts.keys() <= self.channels.keys() and not last_of_unfinished:
                continue
            counts: dict[int, int] = {}
            try:
                for opcode, content in records(self.read(block)):
                    if opcode == Opcode.MESSAGE:
                        channel = _MESSAGE.unpack_from(content)[0]
                        counts[channel] = counts.get(channel, 0) + 1
                    elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                        self._note(opcode, content)
            except RecorderError:
                if not last_of_unfinished:
                    raise
                self.blocks.remove(block)  # was not written completely
                break
            block.counts = counts
        for block in self.blocks:
            if unknown := sorted(block.counts.keys() - self.channels.keys()):
                raise self._damaged(block, f"it has messages of channel {unknown[0]}, which the file does not describe")


def _expand(compression: str, data: memoryview, size: int) -> memoryview:
    if compression == "":
        return data
    if size > _LARGEST:
        raise ValueError(f"it declares {size} bytes; the maximum is {_LARGEST}")
    if compression == "zstd":
        content = memoryview(zstandard.ZstdDecompressor().decompress(data, max_output_size=size))
    elif compression == "lz4":
        content = memoryview(lz4.frame.decompress(data))
    else:
        raise ValueError(f"compression {compression!r} is not supported; use zstd or lz4")
    if len(content) != size:
        raise ValueError(f"it declares {size} bytes but has {len(content)}")
    return content
