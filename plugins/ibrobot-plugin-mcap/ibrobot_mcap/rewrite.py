"""Rewrites an episode, to repair an unfinished one or to copy a part; messages are copied, not decoded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from uuid import NAMESPACE_OID, UUID, uuid5

import attrs
from ibrobot_provenance.recorded_names import TRIMMED_FROM

from ibrobot_core.api import EpisodeStart, EpisodeSummary, RecorderError
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.metadata import MARKED, MISSING, STATED
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.owning import REPAIRING, UNFINISHED, beside, owning
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.storage import Storage

REPAIRED = "repaired"
"""Key of `custom_data` that states that an episode was repaired."""


def rewrite(
    source: Path,
    target: Path,
    *,
    begin_ns: int | None = None,
    end_ns: int | None = None,
    marks: Mapping[str, str] | None = None,
) -> EpisodeSummary:
    """Copy the messages of an episode to a new one, and return the summary of that.

    Args:
        source: an episode, finished or not.
        target: folder of the new episode; its name becomes part of the file names.
        begin_ns: time of receipt of the first message to copy [ns]; earlier messages of latched topics are kept.
        end_ns: time of receipt of the last message to copy [ns].
        marks: keys to add to the metadata.

    The outcome of a part without the end is unknown.

    Raises:
        RecorderError: if `source` cannot be read or `target` cannot be written; `target` is then removed.
    """
    with closing(Rosbag2Reader(source)) as reader:
        summary = reader.summary()
        topics = {name: reader.stored(name) for name in reader.source.types}
        start_ns = summary.start_ns if begin_ns is None else begin_ns
        metadata, outcome = {**summary.metadata, **(marks or {})}, summary.outcome
        if begin_ns is not None or end_ns is not None:
            metadata |= _of_a_part(reader, summary, begin_ns, end_ns)
        if end_ns is not None and end_ns < summary.end_ns and outcome != "unknown":
            metadata[STATED], outcome = outcome, "unknown"
            metadata.pop(MARKED, None)
        if missing := {name: topic.missing for name, topic in summary.topics.items() if topic.missing}:
            metadata[MISSING] = json.dumps(missing)
        options = McapOptions(min_free=0, compression=reader.compression())
        storage = Storage(EpisodeStart(target, start_ns, summary.metadata, metadata), options)
        try:
            for topic in topics.values():
                storage.announce(topic)
            for raw in reader.raw():
                if end_ns is not None and raw.received_ns > end_ns:
                    break
                if begin_ns is not None and raw.received_ns < begin_ns and raw.topic not in reader.source.latched:
                    continue
                received_ns = max(raw.received_ns, start_ns)
                storage.write(Item(topics[raw.topic], memoryview(raw.data), received_ns, raw.published_ns))
            dropped = {name: topic.dropped for name, topic in summary.topics.items() if topic.dropped}
            storage.finish(outcome, dropped)
        except BaseException:
            storage.discard()
            raise
    with closing(Rosbag2Reader(target)) as written:
        return written.summary()


def _of_a_part(
    reader: Rosbag2Reader, summary: EpisodeSummary, begin_ns: int | None, end_ns: int | None
) -> dict[str, str]:
    """Metadata of a part of an episode: its own UUID, and the recordings that contain it."""
    uuid = summary.metadata.get("uuid", summary.path.name)
    own = str(uuid5(NAMESPACE_OID, f"{uuid} {begin_ns} {end_ns}"))
    whole = uuid if _is_random(uuid) else reader.digest()
    return {"uuid": own, TRIMMED_FROM: f"{summary.metadata.get(TRIMMED_FROM, '')} {whole}".strip()}


def repair(path: Path) -> EpisodeSummary | None:
    """Repair an unfinished or incomplete episode in place, and return its summary; None if it is already complete.

    The metadata records the missing messages and the former outcome; the new outcome is unknown. The original is
    renamed to `.NAME.unfinished` until the new episode has been read back and has every message.

    Raises:
        InUse: if it is being recorded or changed.
        RecorderError: if it cannot be read or written; the original is then restored.
    """
    with owning(path, "is being repaired"):
        return _repair(path)


def _repair(path: Path) -> EpisodeSummary | None:
    with closing(Rosbag2Reader(path)) as reader:
        before, short = reader.summary(), reader.short()
    if before.finished and not short:
        return None
    if not path.is_dir():
        raise RecorderError(f"{path}: repair takes the episode's folder, not a file of it")
    staging, aside = beside(path, REPAIRING), beside(path, UNFINISHED)
    if aside.exists():
        raise RecorderError(f"{aside} exists already, from an interrupted repair; decide which one to keep")
    try:
        staging.mkdir()
        marks = {REPAIRED: "true"} | ({STATED: before.stated_outcome} if before.stated_outcome != "unknown" else {})
        made = rewrite(path, staging / path.name, marks=marks)
        counts = [{n: t.count for n, t in s.topics.items() if t.count} for s in (before, made)]
        if counts[0] != counts[1] or not made.finished:
            raise RecorderError(f"{path}: the repaired episode has {counts[1]}, the original {counts[0]}")
        path.rename(aside)
        made.path.rename(path)
        shutil.rmtree(aside)
    except OSError as error:
        raise RecorderError(f"{path}: cannot be repaired: {error.strerror}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return attrs.evolve(made, path=path)


def _is_random(uuid: str) -> bool:
    """Whether a UUID identifies one recording; in lockstep it is derived from the run."""
    try:
        return UUID(uuid).version == 4
    except ValueError:
        return False
