"""A made-up plugin: episodes and datasets as JSON, so that conversion needs no other plugin."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
from ibrobot_data.errors import DiskFull
from ibrobot_provenance.datasets import DatasetDescriptor, DatasetSummary, DatasetWriter

from ibrobot_core.api import (
    DatasetError,
    EpisodeAddress,
    EpisodeEnd,
    EpisodeReader,
    EpisodeStart,
    EpisodeSummary,
    Feature,
    Float64MultiArray,
    Header,
    JointState,
    Message,
    ReaderDescriptor,
    Recorded,
    Recorder,
    RecorderDescriptor,
    RecorderError,
    String,
    TopicSummary,
    hookimpl,
)


def _values(message: Message) -> Any:
    match message:
        case JointState():
            return [message.header.stamp_ns, list(message.name), [float(each) for each in message.position]]
        case Float64MultiArray():
            return [float(each) for each in message.data]
        case String():
            return message.data
    raise RecorderError(f"{message.ros_type} has no place in these files")


def _message(ros_type: str, values: Any) -> Message:
    match ros_type:
        case JointState.ros_type:
            return JointState(Header(values[0]), tuple(values[1]), np.array(values[2]))
        case Float64MultiArray.ros_type:
            return Float64MultiArray(np.array(values))
    return String(values)


class JsonRecorder(Recorder):
    """Writes `episode.json` when an episode ends."""

    @override
    def begin(self, episode: EpisodeStart) -> None:
        episode.directory.mkdir()
        self.start = episode
        self.lines: list[Any] = []

    @override
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        self.lines.append([topic, received_ns, _values(message)])

    @override
    def end(self, episode: EpisodeEnd) -> Path | None:
        found = {
            "topics": dict(self.start.topics),
            "metadata": dict(self.start.metadata),
            "outcome": episode.outcome,
            "messages": self.lines,
        }
        (self.start.directory / "episode.json").write_text(json.dumps(found))
        return self.start.directory


class JsonReader(EpisodeReader):
    """Reads what `JsonRecorder` wrote."""

    def __init__(self, address: EpisodeAddress) -> None:
        self.path = address.path
        self.text = (self.path / "episode.json").read_text()
        self.found = json.loads(self.text)

    @override
    def summary(self) -> EpisodeSummary:
        lines = self.found["messages"]
        return EpisodeSummary(
            self.path,
            True,
            lines[0][1] if lines else 0,
            lines[-1][1] if lines else 0,
            {
                topic: TopicSummary(kind, sum(line[0] == topic for line in lines))
                for topic, kind in self.found["topics"].items()
            },
            self.found["metadata"],
            self.found["outcome"],
            self.found["outcome"],
        )

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        for topic, received_ns, values in self.found["messages"]:
            if values == "damaged":
                raise RecorderError(f"{self.path}: damaged after {received_ns} ns")
            if topics is None or topic in topics:
                yield Recorded(topic, _message(self.found["topics"][topic], values), received_ns, received_ns)

    @override
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.found["messages"]).encode()).hexdigest()

    @override
    def close(self) -> None:
        pass


class JsonWriter(DatasetWriter):
    """A dataset is one file `dataset.json`."""

    @override
    def create(self, root: Path, fps: float, features: Mapping[str, Feature], metadata: Mapping[str, Any]) -> None:
        root.mkdir(parents=True, exist_ok=True)
        self.file = root / "dataset.json"
        self.rows: list[Any] = []
        self.found: dict[str, Any] = {
            "fps": fps,
            "features": {key: attrs.asdict(feature) for key, feature in features.items()},
            "metadata": metadata,
            "episodes": [],
        }
        self._save()

    @override
    def add_frame(self, values: Mapping[str, Any], task: str) -> None:
        row = {key: np.asarray(value).tolist() for key, value in values.items()}
        self.rows.append({**row, "task": task})

    @override
    def save_episode(self) -> int:
        if not self.rows:
            raise DatasetError("the episode has no frames")
        if Path(self.rows[0]["task"]).is_file():  # the test's, while the disk is full
            raise DiskFull("no space left on device")
        self.found["episodes"].append(self.rows)
        self.rows = []
        self._save()
        return len(self.found["episodes"]) - 1

    @override
    def finalize(self) -> None:
        self.rows = []

    @override
    def summary(self, root: Path) -> DatasetSummary | None:
        if not (root / "dataset.json").exists():
            return None
        found = json.loads((root / "dataset.json").read_text())
        features = {
            key: Feature(each["dtype"], tuple(each["shape"]), tuple(each["names"]))
            for key, each in found["features"].items()
        }
        frames = sum(map(len, found["episodes"]))
        return DatasetSummary(found["fps"], features, found["metadata"], len(found["episodes"]), frames)

    @override
    def merge(self, root: Path, parts: Sequence[Path], metadata: Mapping[str, Any]) -> None:
        found = [json.loads((part / "dataset.json").read_text()) for part in parts]
        there = root / "dataset.json"
        merged = json.loads(there.read_text()) if there.exists() else {**found[0], "episodes": []}
        merged["episodes"] += [episode for each in found for episode in each["episodes"]]
        merged["metadata"] = dict(metadata)
        there.with_suffix(".new").write_text(json.dumps(merged))
        shutil.move(there.with_suffix(".new"), there)

    def _save(self) -> None:
        self.file.write_text(json.dumps(self.found))


@hookimpl
def ibrobot_recorders() -> Iterable[RecorderDescriptor]:
    """The recorder."""
    yield RecorderDescriptor("json", make=lambda options, ctx: JsonRecorder(), summary="episodes as JSON")


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """The reader."""
    yield ReaderDescriptor("json", "episodes as JSON", lambda path: (path / "episode.json").exists(), JsonReader)


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """The writer."""
    yield DatasetDescriptor("json", make=lambda options, ctx: JsonWriter(), summary="datasets as JSON")
