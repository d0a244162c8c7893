"""Sources of an episode's messages: scanned MCAP files, or others."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import override

import attrs
from mcap.records import Channel

from ibrobot_mcap.scan import Entry, McapFile

CDR = "cdr"
"""The serialisation of ROS 2, as bags name it."""


@attrs.frozen
class Raw:
    """An undecoded message."""

    topic: str
    type: str
    data: bytes
    received_ns: int
    published_ns: int


class Source(ABC):
    """Raw messages and metadata of a bag."""

    finished: bool
    custom: Mapping[str, str]
    """`custom_data` of the bag."""
    types: Mapping[str, str]
    """Topic -> type."""
    counts: Mapping[str, int]
    """Topic -> number of messages."""
    stated: Mapping[str, int] = {}
    """Topic -> number of messages in the files' statistics; empty if they have none."""
    encodings: Mapping[str, str] = {}
    """Topic -> serialisation of its messages, for those that are not all CDR."""
    definitions: Mapping[str, str]
    """Type -> definition, if the bag has it."""
    compression: str = ""
    """Compression of the first chunk: `zstd`, `lz4`, or empty."""
    repeated: Mapping[str, int] = {}
    """Topic -> number of copies in later files, which `counts` and `messages` exclude."""
    latched: frozenset[str] = frozenset()
    """Topics offered as transient local."""
    start_ns: int
    end_ns: int

    @abstractmethod
    def messages(self, topics: Collection[str], since_ns: int = 0) -> Iterator[Raw]:
        """Yield the messages of these topics received at `since_ns` [ns] or later, in the order of receipt."""

    @abstractmethod
    def close(self) -> None:
        """Release the files. Safe to call twice."""


def _by_topic(file: McapFile, counts: Mapping[int, int]) -> Counter[str]:
    """Numbers of messages by channel as those by topic, which may have several channels."""
    by_topic: Counter[str] = Counter()
    for key, count in counts.items():
        if key in file.channels:
            by_topic[file.channels[key].topic] += count
    return by_topic


class McapSource(Source):
    """MCAP files, finished or not. Messages that a file repeats from the previous one are skipped."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._files: list[McapFile] = []
        try:
            for path in paths:
                self._files.append(McapFile(path))
        except BaseException:
            self.close()
            raise
        # The first file's repeated messages are kept: their originals are not among these files.
        blocks = [
            (block.start_ns, number, block)
            for number, file in enumerate(self._files)
            for block in file.blocks
            if not (number and block.repeated)
        ]
        self._blocks = sorted(blocks, key=lambda item: item[0])
        self.finished = all(file.finished for file in self._files)
        filled = [block for _, _, block in blocks if block.start_ns <= block.end_ns]
        self.start_ns = min((block.start_ns for block in filled), default=0)
        self.end_ns = max((block.end_ns for block in filled), default=0)
        self.metadata = [record for file in self._files for record in file.metadata]
        self.latched = frozenset(
            channel.topic
            for file in self._files
            for channel in file.channels.values()
            if "transient_local" in channel.metadata.get("offered_qos_profiles", "")
        )
        self.compression = next((file.compression(block) for file in self._files for block in file.blocks), "")
        types: dict[str, str] = {}
        self.definitions, self.encodings = {}, {}
        for file in self._files:
            for schema in file.schemas.values():
                if schema.encoding in ("ros2msg", "ros2idl"):
                    self.definitions[schema.name] = schema.data.decode("utf-8", "replace")
            for channel in file.channels.values():
                schema_of = file.schemas.get(channel.schema_id)
                types[channel.topic] = schema_of.name if schema_of else "?"
                if channel.message_encoding != CDR:
                    self.encodings = {**self.encodings, channel.topic: channel.message_encoding}
        counts, copies, stated = Counter(dict.fromkeys(types, 0)), Counter[str](), Counter[str]()
        for number, file in enumerate(self._files):
            stated.update(_by_topic(file, file.stated))
            for block in file.blocks:
                (copies if number and block.repeated else counts).update(_by_topic(file, block.counts))
        self.types, self.counts, self.repeated, self.stated, self.custom = types, counts, copies, stated, {}

    @override
    def messages(self, topics: Collection[str], since_ns: int = 0) -> Iterator[Raw]:
        # Equal stamps keep the order of writing: file, chunk, position.
        waiting: list[tuple[int, int, int, int, Entry]] = []
        for index, (_, number, block) in enumerate(self._blocks):
            file = self._files[number]
            wanted = {key for key, channel in file.channels.items() if channel.topic in topics}
            if block.end_ns >= since_ns and not wanted.isdisjoint(block.counts):
                for place, entry in enumerate(file.entries(block)):
                    if entry.channel in wanted and entry.received_ns >= since_ns:
                        heapq.heappush(waiting, (entry.received_ns, number, block.offset, place, entry))
            # No later block begins before this time.
            bound = self._blocks[index + 1][0] if index + 1 < len(self._blocks) else 2**64
            while waiting and waiting[0][0] < bound:
                _, origin, _, _, entry = heapq.heappop(waiting)
                yield self._raw(self._files[origin].channels[entry.channel], entry)

    def _raw(self, channel: Channel, entry: Entry) -> Raw:
        # Copy: a view would keep the whole chunk in memory.
        return Raw(channel.topic, self.types[channel.topic], bytes(entry.data), entry.received_ns, entry.published_ns)

    @override
    def close(self) -> None:
        for file in self._files:
            file.close()
