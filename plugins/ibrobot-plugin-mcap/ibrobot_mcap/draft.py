"""Drafts a contract from the topics of a bag, with comments where the user must choose."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import count, islice
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import (
    MESSAGE_TYPES,
    NS_PER_S,
    Float64MultiArray,
    Image,
    JointState,
    Message,
    RecorderError,
    String,
)
from ibrobot_mcap.reader import Rosbag2Reader

_COMMAND = re.compile(r"command|cmd|action|goal|target|leader|trajectory|desired")
"""Parts of the names of command topics."""
_COMMON = frozenset(
    ("camera", "image", "image_raw", "image_rect", "compressed", "compresseddepth", "color", "rgb", "raw")
)
_SIGNALS = {
    "next.reward": re.compile(r"reward|return|score"),
    "next.done": re.compile(r"done|terminal|terminated|truncated|finished|success|succeeded"),
    "task": re.compile(r"task|prompt|instruction|language"),
}
"""Key of a signal -> words in the names of its topics."""
_LOOKED_AT = 30
"""Number of messages from which to estimate a topic's rate."""
_MOST = 64
"""Maximum number of values of a message to list."""
_HEAD = """\
# A draft by `ibrobot contract init` from {bag}.
# Read every line marked CHOOSE. Units must be SI: values are copied from the bag without conversion.
"""


@attrs.frozen
class _Topic:
    """A topic of the bag and its first message."""

    name: str
    type: str
    count: int
    rate_hz: float
    first: Message

    @property
    def signal(self) -> str:
        """The key of the signal that the topic resembles; empty if none."""
        words = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", self.name).lower())
        if not isinstance(self.first, String) and len(_paths(self)) != 1:
            return ""
        keys = ["task"] if isinstance(self.first, String) else ["next.reward", "next.done"]
        return next((key for key in keys if any(_SIGNALS[key].fullmatch(word) for word in words)), "")

    @property
    def is_command(self) -> bool:
        """Whether the topic resembles commands."""
        return _COMMAND.search(self.name.lower()) is not None


def draft(reader: Rosbag2Reader) -> str:
    """Draft a contract as YAML.

    Raises:
        RecorderError: if the bag has no suitable topics.
    """
    summary = reader.summary()
    readable = [topic for name, each in summary.topics.items() if (topic := _topic(reader, name, each.count))]
    signals = [topic for topic in readable if topic.signal]
    topics = [topic for topic in readable if topic not in signals]
    cameras = [topic for topic in topics if isinstance(topic.first, Image)]
    vectors = [topic for topic in topics if topic not in cameras and any(_numbers(topic.first))]
    if not cameras and not vectors:
        reasons = "".join(f"; {topic} cannot be read: {why}" for topic, why in reader.unreadable.items())
        raise RecorderError(f"{summary.path}: has no topic with images or numbers that can be read{reasons}")
    actions = [topic for topic in vectors if topic.is_command]
    states = [topic for topic in vectors if topic not in actions]
    rate_hz = round(min((topic.rate_hz for topic in cameras), default=30.0)) or 1
    lines = [_HEAD.format(bag=summary.path.name) + "contract:"]
    lines.append(f"  rate_hz: {rate_hz}  # CHOOSE: rows per second; a whole number, at most the slowest camera's rate")
    lines.append("  observations:")
    for topic in states:
        lines += _state(topic)
    names = Counter(_name(topic.name) for topic in cameras)
    for topic in cameras:
        lines += _camera(topic, alone=names[_name(topic.name)] == 1)
    lines.append("  actions:" if actions else "  actions: []  # CHOOSE: no topic looks like commands; see above")
    unnamed = count()
    for topic in actions:
        lines += _action(topic, unnamed)
    lines += _signals(signals)
    return "\n".join(lines) + "\n"


def _topic(reader: Rosbag2Reader, name: str, messages: int) -> _Topic | None:
    """A topic with its first message; None if no message can be read."""
    try:
        items = list(islice(reader.messages({name}), _LOOKED_AT))
    except RecorderError:
        return None
    if not items:
        return None
    periods = np.diff([item.received_ns for item in items])
    rate_hz = NS_PER_S / float(np.median(periods)) if periods.size and np.median(periods) > 0 else 0.0
    return _Topic(name, items[0].message.ros_type, messages, rate_hz, items[0].message)


def _state(topic: _Topic) -> list[str]:
    numbers = _paths(topic)
    if isinstance(topic.first, JointState):
        numbers = [path for path in numbers if path.startswith("position.")] or numbers
        key, remark = "observation.state", "the joints, in the order for the policy"
    else:
        key, remark = f"observation.{_name(topic.name)}", "the values for the policy; or remove this observation"
    align = "header" if hasattr(topic.first, "header") else "receive"
    return [
        f"    - key: {_quoted(key)}  # CHOOSE: {remark}",
        *_source(topic),
        f"      select: [{', '.join(_quoted(path) for path in numbers)}]",
        f"      align: {{strategy: hold, stamp: {align}}}",
    ]


def _camera(topic: _Topic, *, alone: bool) -> list[str]:
    """Lines for a camera's topic; `alone`: no other topic has the same short name."""
    picture: Any = topic.first
    name = _name(topic.name) if alone else "_".join(topic.name.strip("/").split("/"))
    remark = "" if alone else "  # CHOOSE: another topic seems to be from the same camera; keep one"
    tolerance_ms = round(3000 / max(topic.rate_hz, 1))
    lines = [f"    - key: {_quoted(f'observation.images.{name}')}{remark}", *_source(topic)]
    if picture.encoding in ("16UC1", "32FC1", "mono8"):
        lines.append(f"      image: {{encoding: {picture.encoding}}}")
    return [
        *lines,
        f"      # CHOOSE: image: {{resize: [HEIGHT, WIDTH]}} makes it smaller than {picture.height} x {picture.width}",
        f"      align: {{strategy: asof, stamp: header, tol_ms: {tolerance_ms}}}  # three periods of the camera",
    ]


def _action(topic: _Topic, unnamed: Iterator[int]) -> list[str]:
    paths = _paths(topic)
    if isinstance(topic.first, JointState):
        paths = [path for path in paths if path.startswith("position.")] or paths
    plain = isinstance(topic.first, Float64MultiArray)
    names = [path.rpartition("position.")[2] if "position." in path else f"joint_{next(unnamed)}" for path in paths]
    select = [] if plain else [f"      select: [{', '.join(_quoted(path) for path in paths)}]"]
    return [
        f"    - topic: {_quoted(topic.name)}  # CHOOSE: is this the command of the robot?",
        f"      type: {topic.type}",
        *select,
        f"      joints: [{', '.join(_quoted(name) for name in names)}]  # CHOOSE: their names",
        "      # CHOOSE: hold is the command in effect at a row; next is the first after it, better for slow commands",
        f"      align: {'hold' if topic.rate_hz > 45 else 'next'}",
    ]


def _signals(topics: Sequence[_Topic]) -> Iterator[str]:
    """Lines for signals, commented out, because rows begin only when every signal has a message."""
    if topics:
        yield "  # CHOOSE: uncomment the signals for each row of the dataset; rows begin when all signals have one."
        yield "  # hold is the newest message at a row; next is the first one after it, as for a reward per step."
        yield "  # signals:"
    for topic in sorted(topics, key=lambda topic: list(_SIGNALS).index(topic.signal)):
        path = "data" if topic.signal == "task" else _paths(topic)[0]
        yield f"  #   - key: {topic.signal}"
        yield f"  #     topic: {_quoted(topic.name)}  # {_rate(topic)}"
        yield f"  #     type: {topic.type}"
        yield f"  #     select: [{_quoted(path)}]"
        yield f"  #     align: {'next' if topic.signal == 'next.reward' else 'hold'}"


def _rate(topic: _Topic) -> str:
    """The rate of a topic; unknown if it has only a few messages."""
    return f"{topic.rate_hz:.1f} Hz" if topic.count >= _LOOKED_AT else f"messages: {topic.count}"


def _source(topic: _Topic) -> Iterator[str]:
    yield f"      topic: {_quoted(topic.name)}  # {_rate(topic)}"
    yield f"      type: {topic.type}"
    if topic.type not in MESSAGE_TYPES:
        yield "      foreign: true"


def _paths(topic: _Topic) -> list[str]:
    return list(_numbers(topic.first))[:_MOST]


def _numbers(value: Any, path: str = "") -> Iterator[str]:
    """Yield paths to the numbers of a message, without stamps; joints by name."""
    if isinstance(value, JointState):
        for field in ("position", "velocity", "effort"):
            if len(getattr(value, field)) == len(value.name):
                yield from (f"{field}.{name}" for name in value.name)
    elif isinstance(value, bool | int | float | np.number | np.bool_):
        if not path.endswith("_ns"):
            yield path
    elif attrs.has(type(value)):
        for field in attrs.fields(type(value)):
            if field.name not in ("header", "layout"):
                yield from _numbers(getattr(value, field.name), f"{path}.{field.name}".lstrip("."))
    elif isinstance(value, np.ndarray | tuple | list) and 0 < len(value) <= _MOST:
        for i, each in enumerate(value):
            yield from _numbers(each, f"{path}.{i}")


def _name(topic: str) -> str:
    """A short name of a topic, without generic parts."""
    parts = [part for part in topic.lower().strip("/").split("/") if part]
    return "_".join([part for part in parts if part not in _COMMON] or parts[-1:] or ["topic"])


def _quoted(text: str) -> str:
    return text if re.fullmatch(r"[A-Za-z_/][\w./-]*", text) and text.lower() not in _YAML_WORDS else json.dumps(text)


_YAML_WORDS: Mapping[str, None] = dict.fromkeys(("y", "n", "yes", "no", "on", "off", "true", "false", "null"))
