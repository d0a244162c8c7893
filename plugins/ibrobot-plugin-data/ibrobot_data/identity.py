"""Identity of episodes, independent of their folders and names."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any
from uuid import UUID

from ibrobot_core.api import DatasetError, EpisodeReader, EpisodeSummary

UUID_KEY = "uuid"
"""Key of the metadata. The value is random for a live recording, and derived from the other metadata in lockstep."""


def identity(reader: EpisodeReader, summary: EpisodeSummary) -> str:
    """Hash of an episode in its present state: equal for copies, different for another part of it.

    A random UUID with counts and stamps identifies it without reading the messages; otherwise their content does.

    Raises:
        RecorderError: when the messages have to be read and cannot be.
    """
    uuid = _random_uuid(summary.metadata)
    if not uuid:
        return reader.digest()
    counts = {topic: each.count for topic, each in sorted(summary.topics.items())}
    known = json.dumps([uuid, summary.start_ns, summary.end_ns, counts])
    return hashlib.sha256(known.encode()).hexdigest()


class KnownEpisodes:
    """The episodes in a dataset.

    Args:
        kept: what the dataset stores about each; see `provenance`.
    """

    def __init__(self, kept: Iterable[Mapping[str, Any]] = ()) -> None:
        episodes = list(kept)
        self._identities = {each["identity"]: each["source"] for each in episodes if each.get("identity")}
        self._uuids = {uuid: each["source"] for each in episodes if (uuid := _random_uuid(each.get("recorded", {})))}
        self._names = {(each["source"], each["start_ns"]) for each in episodes if not each.get("identity")}
        self._empty = not episodes

    def find(self, source: str, reader: EpisodeReader, summary: EpisodeSummary) -> str:
        """Why the episode need not be added; empty if it is new.

        Raises:
            DatasetError: when the dataset has the episode in another state.
            RecorderError: when it cannot be read.
        """
        if self._empty:
            return ""
        if (source, summary.start_ns) in self._names:
            return "already in the dataset, by its name and start: the dataset is older than episodes' identities"
        if identity(reader, summary) in self._identities:
            return "already in the dataset"
        if (known := self._uuids.get(_random_uuid(summary.metadata))) is not None:
            raise DatasetError(
                f"the dataset has another state of this episode, as {known}: it was converted before it was finished, "
                "repaired or changed; convert into a new dataset"
            )
        return ""


def _random_uuid(metadata: Mapping[str, str]) -> str:
    """The episode's UUID; empty if it has none, or one that is not random."""
    try:
        uuid = UUID(metadata.get(UUID_KEY, ""))
    except ValueError:
        return ""
    return str(uuid) if uuid.version == 4 else ""
