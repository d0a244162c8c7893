"""Which episode of a dataset is which, wherever it lies and whatever it is called."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from typing import Any
from uuid import UUID

from ibrobot_core.api import DatasetError, EpisodeReader, EpisodeSummary

UUID_KEY = "uuid"
"""Of the metadata: random where an episode was recorded live, made of the other metadata where it was in lockstep."""


def identity(reader: EpisodeReader, summary: EpisodeSummary) -> str:
    """What tells an episode, as it is now, from every other: equal for copies, other for another part of it.

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
    """The episodes that a dataset has.

    Args:
        kept: what it keeps of each; see `provenance`.
    """

    def __init__(self, kept: Iterable[Mapping[str, Any]] = ()) -> None:
        episodes = list(kept)
        self._identities = {each["identity"]: each["source"] for each in episodes if each.get("identity")}
        self._uuids = {uuid: each["source"] for each in episodes if (uuid := _random_uuid(each.get("recorded", {})))}
        self._names = {(each["source"], each["start_ns"]) for each in episodes if not each.get("identity")}
        self._empty = not episodes

    def find(self, source: str, reader: EpisodeReader, summary: EpisodeSummary) -> str:
        """Why the episode need not be added; empty where it is new.

        Raises:
            DatasetError: when the dataset has another state of it.
            RecorderError: when it cannot be read.
        """
        if self._empty:
            return ""
        if (source, summary.start_ns) in self._names:
            return "in the dataset already, by its name and its start: the dataset is older than episodes' identities"
        if identity(reader, summary) in self._identities:
            return "in the dataset already"
        if (known := self._uuids.get(_random_uuid(summary.metadata))) is not None:
            raise DatasetError(
                f"the dataset has another state of this episode, as {known}: it was converted before it was finished, "
                "repaired or changed; convert into a new dataset"
            )
        return ""


def _random_uuid(metadata: Mapping[str, str]) -> str:
    """The episode's UUID; empty where it has none, or one that others may have too."""
    try:
        uuid = UUID(metadata.get(UUID_KEY, ""))
    except ValueError:
        return ""
    return str(uuid) if uuid.version == 4 else ""
