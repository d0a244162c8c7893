"""Plays an episode back: what it contains, the robot's motion, plots of its topics, and pictures by time.

Works for every episode that an installed plugin reads: a recording, or `DATASET:N`.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import (
    JOINT_STATES,
    NS_PER_S,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    Float64MultiArray,
    IbrobotError,
    JointState,
    Recorded,
    resolve_path,
)
from ibrobot_core.app import from_document, installed_plugins
from ibrobot_web.objects import place_of, simulated_objects
from ibrobot_web.pictures import PICTURES, Picture, to_picture
from ibrobot_web.status import numbers_of

STATES_HZ = 30.0
"""Highest rate of the joint states that a page gets [Hz]."""
_MOST_STATES = 20_000
_POINTS = 1000
"""Most points of a plot."""
_AHEAD_NS, _BACK_NS = 2 * NS_PER_S, NS_PER_S
"""A picture up to this far ahead is reached by reading on; otherwise reading begins this long before its time [ns]."""
_LONG = 300
"""Longer values of the metadata are not shown [characters]."""


@attrs.define(eq=False)
class _Stream:
    """The pictures of a topic, read up to the newest one that was requested."""

    reader: EpisodeReader
    items: Iterator[Recorded] = iter(())
    current: Recorded | None = None
    following: Recorded | None = None
    begun_ns: int = 0
    """Time from which `items` begin."""
    lock: threading.Lock = attrs.field(factory=threading.Lock)

    def at(self, topic: str, stamp_ns: int) -> Recorded | None:
        """The newest picture at a time, if there is one within `_BACK_NS` before it."""
        reached_ns = self.current.received_ns if self.current is not None else self.begun_ns
        if not reached_ns <= stamp_ns <= reached_ns + _AHEAD_NS:
            self.begun_ns = stamp_ns - _BACK_NS
            self.items = self.reader.messages_since(self.begun_ns, {topic})
            self.current, self.following = None, next(self.items, None)
        while self.following is not None and self.following.received_ns <= stamp_ns:
            self.current, self.following = self.following, next(self.items, None)
        newest = self.current
        return newest if newest is not None and newest.received_ns >= stamp_ns - _BACK_NS else None


class Playback:
    """An open episode. Thread-safe.

    Args:
        path: the episode, or `DATASET:N`.

    Raises:
        IbrobotError: if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        reader = installed_plugins().open_episode(path)
        try:
            self.summary = reader.summary()
        except BaseException:
            reader.close()
            raise
        self._plain = _Stream(reader)
        self._streams: dict[str, _Stream] = {}
        self._opening = threading.Lock()
        self._closed = False
        contract = Contract.of_episode(self.summary.metadata)
        self._actions = {part.topic: part.joints for part in contract.action_parts} if contract is not None else {}

    def close(self) -> None:
        """Release the files."""
        with self._opening:
            self._closed = True
            streams, self._streams = [self._plain, *self._streams.values()], {}
        for stream in streams:
            with stream.lock:
                stream.items = iter(())
                stream.reader.close()

    def facts(self) -> dict[str, Any]:
        """What the episode contains, and the robot's motion, as JSON; times from the first message [s]."""
        summary = self.summary
        length_s = (summary.end_ns - summary.start_ns) / NS_PER_S
        cameras = [topic for topic, each in summary.topics.items() if each.type in PICTURES and each.count]
        shown = {key: value for key, value in summary.metadata.items() if len(value) <= _LONG}
        return {
            "duration_s": length_s, "outcome": summary.outcome, "finished": summary.finished, "metadata": shown,
            "task": summary.metadata.get("prompt", ""), "cameras": cameras, "problems": problems_of(summary),
            "topics": [
                {"name": name, "type": each.type, "count": each.count, "lost": each.dropped + each.missing,
                 "rate_hz": round((each.count - 1) / length_s, 1) if length_s and each.count > 1 else None}
                for name, each in summary.topics.items()
            ],
            "motion": self._motion(), "first_picture_s": self._first_picture_s(cameras),
        }  # fmt: skip

    def _first_picture_s(self, cameras: list[str]) -> float:
        """The time from which all cameras have a picture [s]."""
        with self._plain.lock:
            firsts = (next(iter(self._plain.reader.messages({topic})), None) for topic in cameras)
            return max((self._seconds(item) for item in firsts if item is not None), default=0.0)

    def series(self, topic: str) -> dict[str, Any]:
        """The numbers of a topic over time, at most `_POINTS` of each: `times` [s], and `values`, path -> numbers.

        Raises:
            IbrobotError: if the episode has no such topic.
        """
        known = self._topic(topic)
        step = max(1, -(-known.count // _POINTS))
        times: list[float] = []
        rows: list[dict[str, float]] = []
        with self._plain.lock:
            for i, item in enumerate(self._plain.reader.messages({topic})):
                if i % step == 0:
                    times.append(self._seconds(item))
                    rows.append(numbers_of(item.message, self._actions.get(topic, ())))
        names = dict.fromkeys(name for row in rows for name in row)
        return {"times": times, "values": {name: [row.get(name) for row in rows] for name in names}}

    def picture(self, topic: str, at_s: float) -> Picture | None:
        """The newest picture of a camera at a time [s]; None if there is none within the second before.

        Raises:
            IbrobotError: if the episode has no such topic, or a picture is damaged.
        """
        self._topic(topic)
        with self._opening:
            if self._closed:
                raise IbrobotError(f"{self._path}: was closed; open it again")
            if topic not in self._streams:
                self._streams[topic] = _Stream(installed_plugins().open_episode(self._path))
            stream = self._streams[topic]
        with stream.lock:
            message = stream.at(topic, self.summary.start_ns + round(at_s * NS_PER_S))
        return to_picture(message.message) if message is not None else None

    def description(self, find: Callable[[str], Path]) -> dict[str, Any]:
        """The robot's files, as `make_scene` takes them.

        Args:
            find: gives the file of a path which is not `package://…`, or raises IbrobotError.

        Raises:
            IbrobotError: if the episode does not say which robot it is of, or a file is missing.
        """
        try:
            description = json.loads(self.summary.metadata["config"])["robot"]["description"]
            texts = {kind: description[kind] for kind in ("mjcf", "urdf") if isinstance(description.get(kind), str)}
            tip, arms = str(description.get("tip", "")), dict(description.get("arms") or {})
        except (KeyError, TypeError, ValueError, AttributeError):
            raise IbrobotError("the episode does not contain the robot's model") from None
        return {"tip": tip, "arms": arms, **{kind: str(_file(text, find)) for kind, text in texts.items()}}

    def objects(self, find: Callable[[str], Path]) -> list[dict[str, Any]]:
        """The objects of a simulated scene, as pages draw them, with `times` [s] and `poses` of those that move.

        Empty if no topic with their poses was recorded. Arguments as of `description`.
        """
        try:
            self.description(find)
            document = json.loads(self.summary.metadata["config"])
            things = simulated_objects(from_document(document, source=self._path, sim=True))
        except (IbrobotError, KeyError, ValueError):  # the episode says too little, or its plugins are missing
            return []
        moving = {each.topic for each in things if each.topic} & {
            name for name, known in self.summary.topics.items() if known.count
        }
        if not moving:
            return []
        tracks = {topic: self._track(topic) for topic in moving}
        objects = []
        for thing in things:
            placed = {**place_of(thing), "times": [], "poses": []}
            if thing.topic in moving:
                times, vectors = tracks[thing.topic]
                placed["times"] = times
                placed["poses"] = [row[thing.first : thing.first + 7] for row in vectors]
            objects.append(placed)
        return objects

    def _track(self, topic: str) -> tuple[list[float], list[list[float]]]:
        """The vectors of a topic over time, thinned."""
        times: list[float] = []
        rows: list[list[float]] = []
        with self._plain.lock:
            for item in self._plain.reader.messages({topic}):
                message: Any = item.message
                at_s = self._seconds(item)
                if isinstance(message, Float64MultiArray) and (not times or at_s >= times[-1] + 0.9 / STATES_HZ):
                    times.append(at_s)
                    rows.append(np.round(message.data, 4).tolist())
        return times, rows

    def _topic(self, topic: str) -> Any:
        if topic not in self.summary.topics:
            raise IbrobotError(f"{self._path}: has no topic {topic!r}; available: {', '.join(self.summary.topics)}")
        return self.summary.topics[topic]

    def _seconds(self, item: Recorded) -> float:
        return round((item.received_ns - self.summary.start_ns) / NS_PER_S, 4)

    def _motion(self) -> dict[str, Any]:
        """Joint states over time, thinned: `joints`, `times` [s], `positions`, and `commands` where known."""
        states = [topic for topic, each in self.summary.topics.items() if each.type == JointState.ros_type]
        chosen = JOINT_STATES if JOINT_STATES in states else next(iter(states), None)
        motion: dict[str, Any] = {"joints": [], "times": [], "positions": [], "commands": []}
        if chosen is None:
            return motion
        length_s = (self.summary.end_ns - self.summary.start_ns) / NS_PER_S
        step_s = max(0.9 / STATES_HZ, length_s / _MOST_STATES)
        commanded: dict[str, float] = {}
        with self._plain.lock:
            for item in self._plain.reader.messages({chosen, *self._actions}):
                message: Any = item.message
                if item.topic != chosen:
                    if isinstance(message, Float64MultiArray):
                        commanded.update(zip(self._actions[item.topic], message.data.tolist(), strict=False))
                    continue
                at_s = self._seconds(item)
                if motion["times"] and at_s < motion["times"][-1] + step_s:
                    continue
                known = dict(zip(message.name, message.position.tolist(), strict=False))
                motion["joints"] = motion["joints"] or list(known)
                joints = motion["joints"]
                motion["times"].append(at_s)
                motion["positions"].append([_number(known.get(joint)) for joint in joints])
                motion["commands"].append([_number(commanded.get(joint, known.get(joint))) for joint in joints])
        return motion


def problems_of(summary: EpisodeSummary) -> list[str]:
    """The problems of an episode that its summary shows."""
    problems = [] if summary.finished else ["unfinished: its recorder was killed, or the file is cut off"]
    for topic, known in summary.topics.items():
        if known.dropped:
            problems.append(f"{topic}: {counted(known.dropped, 'message')} lost while recording")
        if known.missing:
            problems.append(f"{topic}: {counted(known.missing, 'recorded message')} cannot be read")
    return problems


def _file(text: str, find: Callable[[str], Path]) -> Path:
    """The file of a robot's model: of a package, or one that `find` admits."""
    if not text.startswith("package://"):
        return find(text)
    if ".." in text.split("/"):
        raise IbrobotError(f"the robot's model: {text} leads out of its package")
    try:
        return resolve_path(text, Path())
    except ValueError as error:
        raise IbrobotError(f"the robot's model: {error}") from None


def _number(value: float | None) -> float | None:
    return round(value, 5) if value is not None and np.isfinite(value) else None
