"""A fake recorder with JSON files, and the reader of what it writes."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    MESSAGE_TYPES,
    Context,
    EpisodeAddress,
    EpisodeEnd,
    EpisodeReader,
    EpisodeStart,
    EpisodeSummary,
    Header,
    Message,
    Recorded,
    Recorder,
    RecorderError,
    TopicSummary,
)


class FakeRecorder(Recorder):
    """Writes messages to `records.jsonl`, one flushed line each, as plain values; metadata to `metadata.json`."""

    def __init__(self, ctx: Context) -> None:
        self._episode: EpisodeStart | None = None

    @override
    def begin(self, episode: EpisodeStart) -> None:
        if self._episode is not None:
            raise RecorderError(f"the episode in {self._episode.directory} has not ended")
        if episode.directory.exists():
            raise RecorderError(f"{episode.directory} exists already")
        episode.directory.mkdir()
        self._file = (episode.directory / "records.jsonl").open("w")
        self._episode = episode
        _write_metadata(episode, {"outcome": "unfinished"})

    @override
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        if topic not in self._open().topics and not self._open().any_topic:
            return
        line = {"topic": topic, "received_ns": received_ns, "type": message.ros_type, "message": _plain(message)}
        self._file.write(json.dumps(line) + "\n")
        self._file.flush()

    @override
    def end(self, episode: EpisodeEnd) -> Path | None:
        start = self._open()
        self._file.close()
        self._episode = None
        if episode.outcome == "discarded":
            shutil.rmtree(start.directory)
            return None
        faults = {"faults": list(episode.faults)} if episode.faults else {}
        _write_metadata(start, {"outcome": episode.outcome, "dropped": dict(episode.dropped), **faults})
        return start.directory

    @override
    def close(self) -> None:
        if self._episode is not None:
            self.end(EpisodeEnd(self._episode.stamp_ns, "unknown"))

    def _open(self) -> EpisodeStart:
        if self._episode is None:
            raise RecorderError("no episode has begun")
        return self._episode


def _write_metadata(start: EpisodeStart, closing: Mapping[str, Any]) -> None:
    (start.directory / "metadata.json").write_text(json.dumps({**start.metadata, **closing}))


def _plain(value: Any) -> Any:
    """A message, or a value in one, as JSON values."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if attrs.has(type(value)):
        return {field.name: _plain(getattr(value, field.name)) for field in attrs.fields(type(value))}
    return value


def is_fake_episode(path: Path) -> bool:
    """Whether a path is an episode of this format."""
    return path.is_dir() and (path / "records.jsonl").is_file()


class FakeReader(EpisodeReader):
    """Reads `records.jsonl`: a message in each line, as plain values, with its topic, type and time of receipt."""

    def __init__(self, address: EpisodeAddress) -> None:
        if not is_fake_episode(address.path):
            raise RecorderError(f"{address.path}: has no records.jsonl")
        self._path = address.path
        self._file = self._path / "records.jsonl"

    @override
    def summary(self) -> EpisodeSummary:
        times, counts = [], dict[str, TopicSummary]()
        for item in self.messages():
            times.append(item.received_ns)
            count = counts[item.topic].count if item.topic in counts else 0
            counts[item.topic] = TopicSummary(item.message.ros_type, count + 1)
        known = self._metadata()
        outcome = str(known.get("outcome", "unfinished"))
        finished = outcome != "unfinished"
        texts = {key: value for key, value in known.items() if isinstance(value, str) and key != "outcome"}
        begin, end = (min(times), max(times)) if times else (0, 0)
        stated = outcome if finished else "unknown"
        return EpisodeSummary(self._path, finished, begin, end, counts, texts, stated, stated)

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        with self._file.open("rb") as file:
            for number, line in enumerate(file, start=1):
                try:
                    record = json.loads(line)
                    message = _message(record["type"], record["message"])
                    item = Recorded(record["topic"], message, record["received_ns"], record["received_ns"])
                except (KeyError, TypeError, ValueError) as error:
                    raise RecorderError(f"{self._file}:{number}: not a record: {error}") from error
                if topics is None or item.topic in topics:
                    yield item

    @override
    def digest(self) -> str:
        return hashlib.sha256(self._file.read_bytes()).hexdigest()

    @override
    def close(self) -> None:
        pass

    def _metadata(self) -> dict[str, Any]:
        try:
            known = json.loads((self._path / "metadata.json").read_bytes())
        except (OSError, ValueError):
            return {}
        return known if isinstance(known, dict) else {}


def _message(ros_type: str, fields: Mapping[str, Any]) -> Message:
    """A message whose fields are a header, numbers, texts, or lists of these."""
    made: dict[str, Any] = {name: Header(**value) if name == "header" else value for name, value in fields.items()}
    made = {name: tuple(value) if name == "name" else value for name, value in made.items()}
    return MESSAGE_TYPES[ros_type](**made)
