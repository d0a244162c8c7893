"""Recorder `joint_log`: writes the joint positions of an episode as CSV, for `replay`."""

from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path
from typing import Any, override

import attrs

from ibrobot_core.api import NS_PER_S, Context, EpisodeEnd, EpisodeStart, JointState, Message, Recorder, RecorderError
from ibrobot_jointlog.log import LOG, METADATA, TOPIC, header, row

_FLUSH_NS = NS_PER_S
"""Maximum age of unwritten rows, by their stamps [ns]."""


@attrs.define
class _Episode:
    """An open episode. Rows are written as whole lines, so a process killed at any time leaves a valid log."""

    start: EpisodeStart
    descriptor: int
    checksum: int = 0
    """Checksum up to the last row."""
    written_checksum: int = 0
    """Checksum up to the last row on the disk."""
    size: int = 0
    rows: list[str] = attrs.field(factory=list)
    oldest_ns: int = 0
    newest_ns: int | None = None
    samples: int = 0
    repeated: int = 0

    def flush(self) -> None:
        block, count = "".join(self.rows).encode(), len(self.rows)
        self.rows.clear()
        try:
            written = os.write(self.descriptor, block)
            if written != len(block):
                raise OSError(f"only {written} of {len(block)} bytes were written")
        except OSError as error:
            os.ftruncate(self.descriptor, self.size)
            self.samples, self.checksum = self.samples - count, self.written_checksum  # these rows are lost
            raise RecorderError(f"{self.start.directory / LOG}: {error}") from error
        self.size += len(block)
        self.written_checksum = self.checksum


class JointLogRecorder(Recorder):
    """Writes `joints.csv` and `metadata.json`; times count from the episode's start, by the messages' header stamps."""

    def __init__(self, ctx: Context) -> None:
        self._joints = ctx.robot.joint_names
        self._episode: _Episode | None = None

    @override
    def begin(self, episode: EpisodeStart) -> None:
        if self._episode is not None:
            raise RecorderError(f"the episode in {self._episode.start.directory} has not ended")
        if TOPIC not in episode.topics:
            raise RecorderError(f"joint_log records {TOPIC}, which is not among: {', '.join(sorted(episode.topics))}")
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
        try:
            episode.directory.mkdir()
            opened = _Episode(episode, os.open(episode.directory / LOG, flags, 0o644))
        except OSError as error:
            raise RecorderError(f"cannot record into {episode.directory}: {error}") from error
        try:
            line, opened.checksum = header(self._joints)
            opened.rows.append(line)
            opened.flush()
            self._write_metadata(opened, {"outcome": "unfinished"})
        except RecorderError:
            os.close(opened.descriptor)
            raise
        self._episode = opened

    @override
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        episode = self._open()
        if topic != TOPIC:
            return
        if not isinstance(message, JointState):
            raise RecorderError(f"{TOPIC} carries {message.ros_type}, must be {JointState.ros_type}")
        stamp_ns = message.header.stamp_ns
        if episode.newest_ns is not None and stamp_ns <= episode.newest_ns:
            # After a lost reply, the last reading is published again with its old stamp; skip it.
            episode.repeated += 1
            return
        line, checksum = row(stamp_ns - episode.start.stamp_ns, self._positions(message), episode.checksum)
        if not episode.rows:
            episode.oldest_ns = stamp_ns
        episode.rows.append(line)
        episode.checksum = checksum
        episode.newest_ns = stamp_ns
        episode.samples += 1
        if stamp_ns - episode.oldest_ns >= _FLUSH_NS:
            episode.flush()

    @override
    def end(self, episode: EpisodeEnd) -> Path | None:
        ended = self._open()
        self._episode = None
        directory = ended.start.directory
        try:
            if episode.outcome != "discarded":
                ended.flush()
        finally:
            os.close(ended.descriptor)
        if episode.outcome == "discarded":
            shutil.rmtree(directory)
            return None
        closing = {"outcome": episode.outcome, "end_stamp_ns": episode.stamp_ns, "dropped": dict(episode.dropped)}
        closing |= {"faults": list(episode.faults)} if episode.faults else {}
        self._write_metadata(ended, closing)
        return directory

    @override
    def close(self) -> None:
        if self._episode is not None:
            stamp_ns = self._episode.newest_ns
            self.end(EpisodeEnd(self._episode.start.stamp_ns if stamp_ns is None else stamp_ns, "unknown"))

    def _open(self) -> _Episode:
        if self._episode is None:
            raise RecorderError("no episode has begun")
        return self._episode

    def _positions(self, message: JointState) -> list[float]:
        """Positions in robot order."""
        if len(message.position) != len(message.name):
            raise RecorderError(f"{TOPIC} has {len(message.name)} joints but {len(message.position)} positions")
        positions = dict(zip(message.name, message.position.tolist(), strict=True))
        for joint in self._joints:
            if joint not in positions:
                raise RecorderError(f"{TOPIC} lacks joint {joint!r}; it has: {', '.join(message.name)}")
            if not math.isfinite(positions[joint]):
                raise RecorderError(f"{TOPIC}: position of joint {joint!r} is {positions[joint]}, must be finite")
        return [positions[joint] for joint in self._joints]

    def _write_metadata(self, episode: _Episode, closing: dict[str, Any]) -> None:
        start = episode.start
        facts = {
            "format": "joint_log",
            "start_stamp_ns": start.stamp_ns,
            "metadata": dict(start.metadata),
            "samples": episode.samples,
            "repeated": episode.repeated,
            **closing,
        }
        path = start.directory / METADATA
        try:
            # A process that is killed leaves the old file or the new one, and no part of one.
            new = path.with_suffix(".new")
            new.write_text(json.dumps(facts, indent=2, ensure_ascii=False), encoding="utf-8")
            new.replace(path)
        except OSError as error:
            raise RecorderError(f"{path}: {error}") from error
