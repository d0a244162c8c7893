"""A fake recorder, with JSON files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    Context,
    EpisodeEnd,
    EpisodeStart,
    Message,
    Recorder,
    RecorderError,
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
        self._write_metadata({"outcome": "unfinished"})

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
        if episode.outcome != "discarded":
            faults = {"faults": list(episode.faults)} if episode.faults else {}
            self._write_metadata({"outcome": episode.outcome, "dropped": dict(episode.dropped), **faults})
        self._episode = None
        if episode.outcome == "discarded":
            shutil.rmtree(start.directory)
            return None
        return start.directory

    @override
    def close(self) -> None:
        if self._episode is not None:
            self.end(EpisodeEnd(self._episode.stamp_ns, "unknown"))

    def _open(self) -> EpisodeStart:
        if self._episode is None:
            raise RecorderError("no episode has begun")
        return self._episode

    def _write_metadata(self, closing: Mapping[str, Any]) -> None:
        start = self._open()
        (start.directory / "metadata.json").write_text(json.dumps({**start.metadata, **closing}))


def _plain(value: Any) -> Any:
    """A message, or a value in one, as JSON values."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if attrs.has(type(value)):
        return {field.name: _plain(getattr(value, field.name)) for field in attrs.fields(type(value))}
    return value
