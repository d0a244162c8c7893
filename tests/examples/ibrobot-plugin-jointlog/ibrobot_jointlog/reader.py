"""Reader `joint_log`: reads a joint log as an episode, for `ibrobot replay`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, override

from ibrobot_core.api import (
    Contract,
    EpisodeAddress,
    EpisodeReader,
    EpisodeSummary,
    Float64MultiArray,
    Header,
    JointState,
    Recorded,
    RecorderError,
    TopicSummary,
    ns,
)
from ibrobot_jointlog.log import LOG, METADATA, TIME, TOPIC, read_log


def is_joint_log(path: Path) -> bool:
    """Whether `path` is a joint log, or the folder of an episode with one."""
    if path.is_dir():
        return (path / LOG).is_file()
    if path.suffix != ".csv":
        return False
    with path.open("rb") as file:
        return file.read(16).removeprefix(b"\xef\xbb\xbf").startswith(f"{TIME},".encode())


class JointLogReader(EpisodeReader):
    """Reads a joint log, alone or in the folder of an episode.

    A log has no commands. If the address contains a robot's contract, the positions are also delivered as commands of
    its actions, for replay. Otherwise they are not, so that they do not become actions of a dataset.

    Raises:
        RecorderError: if the log is invalid, or lacks a joint of the contract's actions.
    """

    sampled = True

    def __init__(self, address: EpisodeAddress) -> None:
        self._path = address.path
        self._file = self._path / LOG if self._path.is_dir() else self._path
        self._facts = _facts(self._file.with_name(METADATA)) if self._file.name == LOG else {}
        self._log = read_log(self._file)
        stated, count = self._facts.get("samples"), len(self._log.times)
        if stated is not None and self._facts.get("outcome") != "unfinished" and stated != count:
            raise RecorderError(f"{self._file}: has {count} samples, {METADATA} says {stated}: lines are missing")
        contract = address.given.get("contract")
        parts = Contract.from_canonical(json.loads(contract)).action_parts if contract is not None else ()
        for part in parts:
            if missing := [joint for joint in part.joints if joint not in self._log.joints]:
                raise RecorderError(f"{self._file}:1: joint {missing[0]!r} of {part.topic} is missing")
        self._commands = {part.topic: [self._log.joints.index(joint) for joint in part.joints] for part in parts}

    @override
    def summary(self) -> EpisodeSummary:
        count, facts = len(self._log.times), self._facts
        dropped = facts.get("dropped", {})
        lost = dropped.get(TOPIC, 0) if isinstance(dropped, dict) else 0  # else not by our recorder
        topics = {TOPIC: TopicSummary(JointState.ros_type, count, lost)}
        topics |= {topic: TopicSummary(Float64MultiArray.ros_type, count) for topic in self._commands}
        outcome = str(facts.get("outcome", "unknown"))
        finished = outcome != "unfinished"
        return EpisodeSummary(
            self._path, finished, self._stamp_ns(0), self._stamp_ns(-1), topics, facts.get("metadata", {}),
            outcome if finished else "unknown",
        )  # fmt: skip

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        for row, positions in enumerate(self._log.positions):
            at_ns = self._stamp_ns(row)
            if topics is None or TOPIC in topics:
                yield Recorded(TOPIC, JointState(Header(at_ns), self._log.joints, positions), at_ns, at_ns)
            for topic, columns in self._commands.items():
                if topics is None or topic in topics:
                    yield Recorded(topic, Float64MultiArray(positions[columns]), at_ns, at_ns)

    @override
    def digest(self) -> str:
        return hashlib.sha256(self._file.read_bytes()).hexdigest()

    @override
    def close(self) -> None:
        pass

    def _stamp_ns(self, row: int) -> int:
        return int(self._facts.get("start_stamp_ns", 0)) + ns(float(self._log.times[row]))


def _facts(path: Path) -> Mapping[str, Any]:
    """The recorder's metadata for the log; empty if there is none."""
    try:
        facts = json.loads(path.read_bytes())
    except FileNotFoundError:
        return {}
    except ValueError as error:
        raise RecorderError(f"{path}: cannot be read: {error}") from None
    if not isinstance(facts, dict):
        raise RecorderError(f"{path}: must be an object")
    return facts
