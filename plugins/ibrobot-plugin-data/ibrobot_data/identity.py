"""Identity of episodes, independent of their folders and names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any
from uuid import UUID

import attrs
from ibrobot_provenance.recorded_names import TRIMMED_FROM

from ibrobot_core.api import DatasetError, EpisodeReader, EpisodeSummary

UUID_KEY = "uuid"
"""Key of the metadata. The value is random for a live recording, and derived from the other metadata in lockstep."""


def identity(reader: EpisodeReader, summary: EpisodeSummary) -> str:
    """Hash of an episode in its present state: equal for copies, different for another part of it.

    A random UUID with counts and stamps identifies it without reading the messages; otherwise their content does.

    Raises:
        RecorderError: when the messages have to be read and cannot be.
    """
    return identity_by_uuid(summary) or reader.digest()


def identity_by_uuid(summary: EpisodeSummary) -> str:
    """Identity of an episode with a random UUID; empty for others, whose messages would have to be read."""
    uuid = _random_uuid(summary.metadata)
    if not uuid:
        return ""
    counts = {topic: each.count for topic, each in sorted(summary.topics.items())}
    known = json.dumps([uuid, summary.start_ns, summary.end_ns, counts])
    return hashlib.sha256(known.encode()).hexdigest()


def recording_of(metadata: Mapping[str, str], identity: str) -> str:
    """Name by which the parts of an episode refer to it: its random UUID, or else its identity."""
    return _random_uuid(metadata) or identity


@attrs.frozen
class _Known:
    """An episode in a dataset."""

    source: str
    outcome: str
    identity: str
    recording: str
    trimmed_from: frozenset[str]
    """The recordings that contain it."""

    @classmethod
    def of(cls, kept: Mapping[str, Any]) -> _Known:
        """Make from what the dataset stores about an episode."""
        recorded, identity = kept.get("recorded", {}), kept.get("identity", "")
        parts = frozenset(recorded.get(TRIMMED_FROM, "").split())
        return cls(kept["source"], kept.get("outcome", ""), identity, recording_of(recorded, identity), parts)

    def is_of(self, source: str, recording: str, trimmed_from: frozenset[str]) -> bool:
        """Whether both are of one recording: one is a part of the other, or both are parts of a third."""
        if self.recording in {recording, *trimmed_from} or recording in self.trimmed_from:
            return True
        return source == self.source and not self.trimmed_from.isdisjoint(trimmed_from)


class KnownEpisodes:
    """The episodes in a dataset.

    Args:
        kept: what the dataset stores about each; see `provenance`.
    """

    def __init__(self, kept: Iterable[Mapping[str, Any]] = ()) -> None:
        episodes = list(kept)
        self._known = [_Known.of(each) for each in episodes if each.get("identity")]
        self._names = {(each["source"], each["start_ns"]) for each in episodes if not each.get("identity")}
        self._empty = not episodes

    def find(self, source: str, reader: EpisodeReader, summary: EpisodeSummary) -> str:
        """The reason not to add an episode; empty if it is new.

        Raises:
            DatasetError: when the dataset has the episode in another state, or with another outcome.
            RecorderError: when it cannot be read.
        """
        if self._empty:
            return ""
        if (source, summary.start_ns) in self._names:
            return "already in the dataset, by its name and start: the dataset is older than episodes' identities"
        present = identity(reader, summary)
        for known in self._known:
            if known.identity != present:
                continue
            if known.outcome != summary.outcome:
                raise DatasetError(
                    f"the dataset has this episode, as {known.source}, with the outcome {known.outcome}; now it is "
                    f"{summary.outcome}: convert into a new dataset"
                )
            return "already in the dataset"
        recording = recording_of(summary.metadata, present)
        trimmed_from = frozenset(summary.metadata.get(TRIMMED_FROM, "").split())
        for known in self._known:
            if known.is_of(source, recording, trimmed_from):
                raise DatasetError(
                    f"the dataset has another state of this episode, as {known.source}: it was converted before it was "
                    "finished, repaired, trimmed or changed; convert into a new dataset"
                )
        return ""


def _random_uuid(metadata: Mapping[str, str]) -> str:
    """The episode's UUID; empty if it has none, or one that is not random."""
    try:
        uuid = UUID(metadata.get(UUID_KEY, ""))
    except ValueError:
        return ""
    return str(uuid) if uuid.version == 4 else ""
