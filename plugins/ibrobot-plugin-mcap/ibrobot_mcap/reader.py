"""Reader `rosbag2`: episodes of recorder `mcap`, finished or not, and foreign bags."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import override

from ibrobot_ros2 import Codec, CodecError
from ibrobot_ros2.pictures import decode_picture, is_known

from ibrobot_core.api import (
    CompressedImage,
    ContractError,
    EpisodeReader,
    EpisodeSummary,
    Image,
    Recorded,
    RecorderError,
    TopicSummary,
)
from ibrobot_mcap.bag_metadata import BagInfo, custom_beside, parse_bag_info, read_bag_info
from ibrobot_mcap.compressed import Expanded, MessageCompressed
from ibrobot_mcap.damage import reading
from ibrobot_mcap.metadata import DROPPED, METADATA, MISSING, OUTCOME, RECORD, RECORD_KEY, Topic
from ibrobot_mcap.options import COMPRESSIONS
from ibrobot_mcap.sources import CDR, McapSource, Raw, Source
from ibrobot_mcap.sqlite_source import SqliteSource

_SOURCES: Mapping[str, Callable[[Sequence[Path]], Source]] = {".mcap": McapSource, ".db3": SqliteSource}
"""Suffix -> source class for such files."""


def is_rosbag2(path: Path) -> bool:
    """Whether `path` is a bag: its folder, or one of its files."""
    if path.is_dir():
        try:
            return (path / METADATA).is_file() or any(_storage_files(path))
        except FileNotFoundError:  # moved meanwhile
            return False
    return path.suffix in _SOURCES


class Rosbag2Reader(EpisodeReader):
    """Reads a rosbag2 directory or one of its files.

    JPEG, PNG and PNG `compressedDepth` images are delivered as `Image`; other formats remain `CompressedImage`.

    Raises:
        RecorderError: if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.exists():
            raise RecorderError(f"{path}: there is no such episode")
        info = read_bag_info(path / METADATA) if path.is_dir() else None
        self._finished = info is not None or not path.is_dir()
        self._closing = ExitStack()
        try:
            with reading(path):
                self.source = self._open(info or BagInfo())
                """Its files."""
            info = info or self._recorded() or BagInfo()
            self._codec = Codec(self.source.definitions)
            stated = {topic: each for topic, each in info.encodings.items() if each != CDR}
            self._encodings = {**stated, **self.source.encodings}
            self._types = {topic: self._delivered(topic, type_) for topic, type_ in self.source.types.items()}
        except BaseException:
            self.close()
            raise
        self._is_part = not path.is_dir() and len(info.files) > 1
        self.stated: Mapping[str, int] = info.counts if path.is_dir() else self.source.stated
        """Topic -> number of messages according to the bag's metadata, including copies in later files."""
        self._stated_types = info.types
        beside = {} if path.is_dir() else custom_beside(path)
        self._custom = dict(beside or info.custom or self.source.custom)

    @property
    def finished(self) -> bool:
        """Whether its writer finished it, and no file is truncated."""
        return self._finished and self.source.finished

    def short(self) -> dict[str, int]:
        """Topic -> number of messages in the metadata that are missing from the files."""
        counts = Counter(self.source.counts) + Counter(self.source.repeated)
        return {topic: stated - counts[topic] for topic, stated in self.stated.items() if stated > counts[topic]}

    @override
    def summary(self) -> EpisodeSummary:
        source = self.source
        custom = dict(self._custom)
        dropped = _read_counts(custom.pop(DROPPED, "{}"))
        short = self.short()
        missing = Counter(_read_counts(custom.pop(MISSING, "{}"))) + Counter(short)
        stated = custom.pop(OUTCOME, "unknown")
        whole = self.finished and not short and not self._is_part
        topics = {
            topic: TopicSummary(type_, source.counts.get(topic, 0), dropped.get(topic, 0), missing[topic])
            for topic, type_ in sorted({**dict.fromkeys(missing, "?"), **self._stated_types, **self._types}.items())
        }
        return EpisodeSummary(
            self._path, self.finished, source.start_ns, source.end_ns, topics, custom,
            stated if whole else "unknown", stated,
        )  # fmt: skip

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        return self.messages_since(0, topics)

    @override
    def messages_since(self, stamp_ns: int, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        source, short = self.source, self.short()
        if short and source.finished:  # the gap is in the middle: the rest would not match the recording
            missing = ", ".join(f"{count} of {self.stated[topic]} of {topic}" for topic, count in short.items())
            raise RecorderError(
                f"{self._path}: is damaged: messages are missing in the middle: {missing}; "
                "`ibrobot episodes repair` keeps what can be read"
            )
        unreadable = {topic: why for topic, why in self.unreadable.items() if topics is None or topic in topics}
        if unreadable and topics is not None:
            raise self._unreadable(unreadable)
        for raw in source.messages(frozenset(source.types if topics is None else topics) - unreadable.keys(), stamp_ns):
            try:
                message = self._codec.decode(raw.type, raw.data)
                if isinstance(message, CompressedImage):
                    message = decode_picture(message) or message
            except (CodecError, ContractError) as error:
                raise RecorderError(f"{self._path}: {raw.topic} at {raw.received_ns} ns: {error}") from error
            yield Recorded(raw.topic, message, raw.received_ns, raw.published_ns)
        if unreadable:
            raise self._unreadable(unreadable)

    @cached_property
    def unreadable(self) -> Mapping[str, str]:
        """Topic with messages -> why they cannot be read, e.g. the type of its messages is not defined.

        `messages` of all topics raises an error about them after it has yielded those of the others.
        """
        reasons: dict[str, str] = {}
        for topic, type_ in self.source.types.items():
            if not self.source.counts.get(topic, 0):
                continue
            if (encoding := self._encodings.get(topic)) is not None:
                reasons[topic] = (
                    f"its messages are serialised as {encoding!r}; ibrobot reads {CDR!r}, as ROS 2 writes it"
                )
                continue
            try:
                self._codec.type_hash(type_)
            except CodecError as error:
                reasons[topic] = str(error)
        return reasons

    def _unreadable(self, topics: Mapping[str, str]) -> RecorderError:
        return RecorderError("\n".join(f"{self._path}: {topic} cannot be read: {why}" for topic, why in topics.items()))

    @override
    def digest(self) -> str:
        content = hashlib.sha256()
        for raw in self.raw():
            content.update(f"{raw.topic} {raw.type} {raw.received_ns} {raw.published_ns} {len(raw.data)}\n".encode())
            content.update(raw.data)
        return content.hexdigest()

    def raw(self) -> Iterator[Raw]:
        """The stored messages, not decoded, in the order of receipt."""
        return self.source.messages(frozenset(self.source.types))

    def stored(self, topic: str) -> Topic:
        """A stored topic (compressed images are `CompressedImage`), with the bag's definition of its type."""
        source, type_ = self.source, self.source.types[topic]
        if topic in self._encodings:
            raise self._unreadable({topic: f"its messages are serialised as {self._encodings[topic]!r}, not {CDR!r}"})
        definition = source.definitions.get(type_, "")
        try:
            type_hash = self._codec.type_hash(type_)
        except CodecError:
            if not definition:
                raise
            type_hash = ""  # a definition in an unknown format
        return Topic(topic, type_, topic in source.latched, definition, type_hash)

    def compression(self) -> str:
        """Compression of its chunks, as a value of the recorder's option; `none` if that has no equivalent."""
        return self.source.compression if self.source.compression in COMPRESSIONS else "none"

    @override
    def close(self) -> None:
        self._closing.close()

    def _delivered(self, topic: str, type_: str) -> str:
        """The type in which `messages` delivers a topic; that of compressed images depends on the first one."""
        if type_ != CompressedImage.ros_type or topic in self._encodings:
            return type_
        first = next(self.source.messages({topic}), None)
        if first is None:
            return type_
        try:
            message = self._codec.decode(type_, first.data)
        except CodecError:
            return type_  # reading it will raise the error
        return Image.ros_type if isinstance(message, CompressedImage) and is_known(message) else type_

    def _recorded(self) -> BagInfo | None:
        """The newest metadata record, for an episode without `metadata.yaml`."""
        source = self.source
        texts = [
            record.metadata[RECORD_KEY]
            for record in (source.metadata if isinstance(source, McapSource) else ())
            if record.name == RECORD and RECORD_KEY in record.metadata
        ]
        return parse_bag_info(texts[-1], self._path) if texts else None

    def _open(self, info: BagInfo) -> Source:
        files = self._files(info)
        if info.compressed == "file":
            expanded = Expanded(files)
            self._closing.callback(expanded.close)
            files = expanded.paths
        suffixes = {file.suffix for file in files}
        if len(suffixes) > 1 or not suffixes <= _SOURCES.keys():
            raise RecorderError(f"{self._path}: its files must all be .mcap, or all .db3; found: {_names(files)}")
        source: Source = _SOURCES[suffixes.pop()](files)
        self._closing.callback(source.close)
        return MessageCompressed(self._path, source) if info.compressed == "message" else source

    def _files(self, info: BagInfo) -> list[Path]:
        path = self._path
        if not path.is_dir():
            if not path.exists():  # moved meanwhile
                raise RecorderError(f"{path}: there is no such episode")
            return [path]
        listed = [path / name for name in info.files]
        for file in listed:
            if not file.is_file():
                raise RecorderError(f"{path}: {file.name} is missing, which {METADATA} lists")
        files = [*listed, *sorted(file for file in _storage_files(path) if file not in listed)]
        if not files:
            raise RecorderError(f"{path}: has no .mcap or .db3 file")
        return files


def _names(files: Sequence[Path]) -> str:
    return ", ".join(file.name for file in files)


def _storage_files(path: Path) -> Iterator[Path]:
    return (file for file in path.iterdir() if file.suffix in _SOURCES and file.is_file())


def _read_counts(text: str) -> Mapping[str, int]:
    try:
        counts = json.loads(text)
    except ValueError:
        return {}  # a foreign key of the same name
    if not isinstance(counts, dict):
        return {}
    return {topic: count for topic, count in counts.items() if isinstance(count, int)}
