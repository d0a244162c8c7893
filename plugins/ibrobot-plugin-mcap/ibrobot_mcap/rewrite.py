"""Rewrites an episode: whole from what a killed recorder left, or a part of it; messages are copied, not decoded."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from uuid import NAMESPACE_OID, uuid5

import attrs

from ibrobot_core.api import EpisodeStart, EpisodeSummary, RecorderError
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.metadata import MISSING
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.reader import Rosbag2Reader
from ibrobot_mcap.storage import Storage

REPAIRED = "repaired"
"""Key of `custom_data` that says that an episode was made whole afterwards."""
STATED = "stated_outcome"
"""Key of what was its outcome before."""


@attrs.frozen
class Rewritten:
    """What came of it."""

    path: Path
    summary: EpisodeSummary
    """Of the new episode."""


def rewrite(
    source: Path, target: Path, *, begin_ns: int | None = None, end_ns: int | None = None,
    marks: Mapping[str, str] | None = None,
) -> Rewritten:  # fmt: skip
    """Copy the messages of an episode into a new one.

    Args:
        source: an episode, finished or not.
        target: where the new one goes; its name becomes part of its files' names.
        begin_ns: receipt of the first message to copy [ns]; a latched topic's message from before it is kept.
        end_ns: receipt of the last [ns].
        marks: what to add to the metadata.

    Raises:
        RecorderError: when one cannot be read or the other not be written; then nothing is left of it.
    """
    with ExitStack() as stack:
        reader = Rosbag2Reader(source)
        stack.callback(reader.close)
        summary = reader.summary()
        latched = reader.latched()
        topics = {name: reader.stored(name) for name in reader.topics}
        start_ns = summary.start_ns if begin_ns is None else begin_ns
        metadata = {**summary.metadata, **(marks or {})}
        if begin_ns is not None or end_ns is not None:  # another episode than the whole one
            metadata["uuid"] = str(uuid5(NAMESPACE_OID, f"{metadata.get('uuid', source.name)} {begin_ns} {end_ns}"))
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
                if begin_ns is not None and raw.received_ns < begin_ns and raw.topic not in latched:
                    continue
                received_ns = max(raw.received_ns, start_ns)
                storage.write(Item(topics[raw.topic], memoryview(raw.data), received_ns, raw.published_ns))
            dropped = {name: topic.dropped for name, topic in summary.topics.items() if topic.dropped}
            storage.finish(summary.outcome, dropped)
        except BaseException:
            storage.discard()
            raise
    written = Rosbag2Reader(target)
    try:
        return Rewritten(target, written.summary())
    finally:
        written.close()


def repair(path: Path) -> Rewritten | None:
    """Make an episode whole that is unfinished or lacks messages, in its place; None when it is whole already.

    What is missing stays written in its metadata, with the outcome that its recorder stated; its outcome is unknown.
    The original is moved aside as `.NAME.unfinished` until the new one has been read back and has every message.

    Raises:
        RecorderError: when it cannot be read or written; the original is then where it was.
    """
    reader = Rosbag2Reader(path)
    try:
        before, short = reader.summary(), reader.short()
    finally:
        reader.close()
    if before.finished and not short:
        return None
    if not path.is_dir():
        raise RecorderError(f"{path}: repair takes the episode's folder, not a file of it")
    staging = path.with_name(f".{path.name}.repairing")
    aside = path.with_name(f".{path.name}.unfinished")
    if aside.exists():
        raise RecorderError(f"{aside} is there already, from a repair that was broken off; see which one to keep")
    try:
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        marks = {REPAIRED: "true"} | ({STATED: before.stated_outcome} if before.stated_outcome != "unknown" else {})
        made = rewrite(path, staging / path.name, marks=marks)
        counts = [{n: t.count for n, t in s.topics.items() if t.count} for s in (before, made.summary)]
        if counts[0] != counts[1] or not made.summary.finished:
            raise RecorderError(f"{path}: the repaired episode has {counts[1]}, the original {counts[0]}")
        path.rename(aside)
        made.path.rename(path)
        shutil.rmtree(aside)
    except OSError as error:
        raise RecorderError(f"{path}: cannot be repaired: {error.strerror}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return Rewritten(path, attrs.evolve(made.summary, path=path))
