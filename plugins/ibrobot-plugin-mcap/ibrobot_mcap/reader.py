"""Reader `rosbag2`: episodes of recorder `mcap`, finished or not, and bags from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, override

import yaml
from ibrobot_ros2 import Codec, CodecError

from ibrobot_core.errors import RecorderError
from ibrobot_core.interfaces import EpisodeReader, EpisodeSummary, Recorded, TopicSummary
from ibrobot_core.messages import CompressedImage, Image
from ibrobot_mcap.jpeg import from_jpeg, is_jpeg
from ibrobot_mcap.metadata import DROPPED, INFORMATION, METADATA, OUTCOME, RECORD, RECORD_KEY, Topic
from ibrobot_mcap.options import COMPRESSIONS
from ibrobot_mcap.sources import McapSource, Raw, Source


def is_rosbag2(path: Path) -> bool:
    """Whether a bag lies at `path`: its folder, or one of its files."""
    if path.is_dir():
        return (path / METADATA).is_file() or any(_storage_files(path))
    return path.suffix in (".mcap", ".db3")


class Rosbag2Reader(EpisodeReader):
    """Reads a rosbag2 directory or a single file of one. JPEG pictures come as `Image`, as a contract asks for them.

    Raises:
        RecorderError: when it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        facts = _read_metadata(path / METADATA) if path.is_dir() else {}
        self._finished = bool(facts) or not path.is_dir()
        self._source = _open(path, facts)
        custom = facts.get("custom_data") or self._source.custom or self._recorded_custom()
        self._custom = {str(key): str(value) for key, value in custom.items()}
        self._codec = Codec(self._source.definitions)
        self._types = {topic: self._delivered(topic, type_) for topic, type_ in self._source.types.items()}

    @override
    def summary(self) -> EpisodeSummary:
        source = self._source
        custom = dict(self._custom)
        dropped = _read_dropped(custom.pop(DROPPED, "{}"))
        outcome = custom.pop(OUTCOME, "unknown")
        topics = {
            topic: TopicSummary(type_, source.counts[topic], dropped.get(topic, 0))
            for topic, type_ in sorted(self._types.items())
        }
        return EpisodeSummary(
            self._path, self._finished and source.finished, source.start_ns, source.end_ns, topics, custom, outcome
        )

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        source = self._source
        for raw in source.messages(frozenset(source.types if topics is None else topics)):
            try:
                message = self._codec.decode(raw.type, raw.data)
                if isinstance(message, CompressedImage) and is_jpeg(message):
                    message = from_jpeg(message)
            except (CodecError, RecorderError) as error:
                raise RecorderError(f"{self._path}: {raw.topic} at {raw.received_ns} ns: {error}") from error
            yield Recorded(raw.topic, message, raw.received_ns, raw.published_ns)

    def raw(self) -> Iterator[Raw]:
        """The messages as they are stored, in the order of receipt."""
        return self._source.messages(frozenset(self._source.types))

    def stored(self, topic: str) -> Topic:
        """A topic as it is stored (JPEG pictures are `CompressedImage`), with what the bag has of its type."""
        source, type_ = self._source, self._source.types[topic]
        definition = source.definitions.get(type_, "")
        try:
            type_hash = self._codec.type_hash(type_)
        except CodecError:
            if not definition:
                raise
            type_hash = ""  # a definition that only others can read
        return Topic(topic, type_, topic in source.latched, definition, type_hash)

    def repeated(self) -> Mapping[str, int]:
        """Topic -> copies in the later files of a split episode, which `messages` passes over."""
        return self._source.repeated

    def compression(self) -> str:
        """Of its chunks, as the recorder's option has it; `none` where that has no such."""
        return self._source.compression if self._source.compression in COMPRESSIONS else "none"

    def latched(self) -> frozenset[str]:
        """Topics whose offered QoS is transient local."""
        return self._source.latched

    @override
    def close(self) -> None:
        self._source.close()

    def _delivered(self, topic: str, type_: str) -> str:
        """The type of the messages that `messages` gives of a topic: its first one tells JPEG from other pictures."""
        if type_ != CompressedImage.ros_type:
            return type_
        first = next(self._source.messages({topic}), None)
        if first is None:
            return type_
        message = self._codec.decode(type_, first.data)
        return Image.ros_type if isinstance(message, CompressedImage) and is_jpeg(message) else type_

    def _recorded_custom(self) -> Mapping[str, str]:
        """What the newest metadata record says, for an episode without `metadata.yaml`."""
        found: Mapping[str, str] = {}
        for record in self._source.metadata if isinstance(self._source, McapSource) else ():
            if record.name == RECORD and RECORD_KEY in record.metadata:
                found = _parse(record.metadata[RECORD_KEY], self._path).get("custom_data") or {}
        return found


def stated_counts(path: Path) -> Mapping[str, int]:
    """Topic -> number of messages, as a `metadata.yaml` states them; nothing where there is none.

    Raises:
        RecorderError: when it cannot be read.
    """
    topics = _read_metadata(path).get("topics_with_message_count") or []
    return {entry["topic_metadata"]["name"]: entry["message_count"] for entry in topics}


def _open(path: Path, facts: Mapping[str, Any]) -> Source:
    if not path.is_dir():
        return McapSource([path]) if path.suffix == ".mcap" else _open_by_rosbags(path)
    listed = [path / Path(name).name for name in facts.get("relative_file_paths", ())]
    for file in listed:
        if not file.is_file():
            raise RecorderError(f"{path}: {file.name} is missing, which {METADATA} lists")
    files = [*listed, *sorted(file for file in _storage_files(path) if file not in listed)]
    if not files:
        raise RecorderError(f"{path}: has no .mcap or .db3 file")
    if all(file.suffix == ".mcap" for file in files) and not facts.get("compression_format"):
        return McapSource(files)
    if not facts:
        raise RecorderError(f"{path}: has no {METADATA}, without which only MCAP files can be read; open one file")
    return _open_by_rosbags(path)


def _open_by_rosbags(path: Path) -> Source:
    from ibrobot_mcap.rosbags_source import RosbagsSource  # takes as long to import as all other modules here

    return RosbagsSource(path)


def _storage_files(path: Path) -> Iterator[Path]:
    return (file for file in path.iterdir() if file.suffix in (".mcap", ".db3") and file.is_file())


def _read_metadata(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise RecorderError(f"{path}: cannot be read: {error}") from error
    return _parse(text, path)


def _parse(text: str, path: Path) -> dict[str, Any]:
    try:
        document = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        facts: dict[str, Any] = dict(document.get(INFORMATION, document))
    except (yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
        raise RecorderError(f"{path}: its metadata is not that of a rosbag2: {error}") from error
    return facts


def _read_dropped(text: str) -> Mapping[str, int]:
    try:
        dropped = json.loads(text)
    except ValueError:
        return {}  # somebody else's key of the same name
    return (
        {topic: count for topic, count in dropped.items() if isinstance(count, int)}
        if isinstance(dropped, dict)
        else {}
    )
