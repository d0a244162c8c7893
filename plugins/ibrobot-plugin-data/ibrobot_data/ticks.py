"""Rows of an episode: observations and the action in effect, at the contract's ticks, by the shared aligner."""

from __future__ import annotations

import heapq
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NoReturn

import attrs
from numpy.typing import NDArray

from ibrobot_core.api import (
    ACTION,
    ActionPart,
    Contract,
    ContractError,
    EpisodeReader,
    Feature,
    Frame,
    Int32,
    Message,
    ObservationPart,
    Recorded,
    RecorderError,
    ns,
    seconds,
)
from ibrobot_core.app import Align, FrameAssembler, SignalPart

TASK_KEY = "task"
"""The key of a signal whose texts replace the prompt."""
_LONGEST_SILENCE_S = 60
"""Maximum time without a message of any topic [s]; a damaged stamp could otherwise produce years of rows."""
_ANY_AGE = Align("asof", "receive", 1e12)
"""Alignment of signals, which may pause: a value of any age counts."""


type _Incomplete = tuple[int, frozenset[str]]
"""Time of an incomplete tick [ns], and what is missing."""


def with_action(contract: Contract) -> Contract:
    """Return the contract with the action as an observation: the commands of the executors, read from their topics.

    With `align: hold` a row has the command in effect at its tick, after the safety layer. With `align: next` it has
    the first command after the tick. A command further from the tick than `max_age` is missing. Signals are aligned in
    the same way, at any age; tasks are indices into `Ticks.tasks`.
    """
    parts = tuple(
        ObservationPart(
            ACTION, _source_of(part), part.type, part.select or ("data",), None, _command(part, contract), feature
        )
        for part, feature in ((part, Feature("float32", (len(part.joints),))) for part in contract.action_parts)
    )
    signals = tuple(
        ObservationPart(part.key, _source_of(part), *_read_as(part), None, _ANY_AGE, part.feature)
        for part in contract.signal_parts
    )
    every = (*contract.observation_parts, *parts, *signals)
    return attrs.evolve(contract, observation_parts=every, action_parts=(), signal_parts=())


def _command(part: ActionPart, contract: Contract) -> Align:
    """Alignment of a part's commands; for those after the tick, `_Following` limits the distance."""
    return _ANY_AGE if part.align == "next" else Align("asof", "receive", _max_age(part, contract) * 1e3)


def _max_age(part: ActionPart, contract: Contract) -> float:
    return contract.max_age if part.max_age is None else part.max_age


def _source_of(part: ActionPart | SignalPart) -> str:
    """Name of the stream of a part's messages: its topic, or a derived name if the messages are changed."""
    changes = ["next"] * (part.align == "next") + [TASK_KEY] * _is_task(part)
    return f"{part.topic} ({', '.join(changes)})" if changes else part.topic


def _read_as(part: SignalPart) -> tuple[str, tuple[str, ...]]:
    """Type and path of the messages in a signal's stream."""
    return (Int32.ros_type, ("data",)) if part.key == TASK_KEY else (part.type, (part.path,))


def _is_task(part: ActionPart | SignalPart) -> bool:
    return isinstance(part, SignalPart) and part.key == TASK_KEY


class _Following:
    """Messages of a topic, each stamped with the receipt of the previous one, or with the episode's start.

    Args:
        max_age_ns: maximum time from a tick to the receipt of its message [ns]; None for no limit.
    """

    def __init__(self, reader: EpisodeReader, part: ActionPart | SignalPart, max_age_ns: int | None) -> None:
        self._reader, self._part, self._max_age_ns = reader, part, max_age_ns
        self.end_ns: int | None = None
        """Receipt of the last message [ns]; None until it is known."""
        self._silences: deque[tuple[int, int]] = deque()
        """Half-open intervals of ticks that no message follows within `max_age_ns` [ns]."""

    def __iter__(self) -> Iterator[Recorded]:
        before_ns = self._reader.summary().start_ns
        for item in self._reader.messages({self._part.topic}):
            if self._max_age_ns is not None and item.received_ns - self._max_age_ns > before_ns:
                self._silences.append((before_ns, item.received_ns - self._max_age_ns))
            yield attrs.evolve(item, topic=_source_of(self._part), received_ns=before_ns)
            before_ns = item.received_ns
        self.end_ns = before_ns

    def is_over(self, t_ns: int) -> bool:
        """Whether no message follows tick `t_ns` [ns]."""
        return self.end_ns is not None and t_ns >= self.end_ns

    def is_silent(self, t_ns: int) -> bool:
        """Whether the message after tick `t_ns` [ns] is too far from it; ticks must not decrease."""
        while self._silences and self._silences[0][1] <= t_ns:
            self._silences.popleft()
        return bool(self._silences) and self._silences[0][0] <= t_ns

    def ends_early(self, t_ns: int) -> bool:
        """Whether the last message is too far before the last tick `t_ns` [ns]."""
        return self.end_ns is not None and self._max_age_ns is not None and t_ns - self.end_ns > self._max_age_ns


def _with_tasks(messages: Iterable[Recorded], part: SignalPart, texts: list[str]) -> Iterator[Recorded]:
    """Replace each message by the index of its text in `texts`, to which new ones are added."""
    for item in messages:
        text = _text_at(item.message, part)
        if text not in texts:
            texts.append(text)
        yield attrs.evolve(item, topic=_source_of(part), message=Int32(texts.index(text)))


class _Source:
    """An episode's messages, and the ticks from the first to the last of them."""

    def __init__(self, reader: EpisodeReader, contract: Contract, tasks: list[str]) -> None:
        aligned: tuple[ActionPart | SignalPart, ...] = (*contract.action_parts, *contract.signal_parts)
        shifted = {
            _source_of(part): _Following(
                reader, part, ns(_max_age(part, contract)) if isinstance(part, ActionPart) else None
            )
            for part in aligned
            if part.align == "next"
        }
        self.following = list(shifted.values())
        """The streams whose messages belong to the ticks before them."""
        direct = {part.topic for part in contract.observation_parts}
        direct |= {part.topic for part in aligned if _source_of(part) == part.topic}
        streams: dict[str, Iterable[Recorded]] = {"": reader.messages(direct), **shifted}
        for part in contract.signal_parts:
            if part.key == TASK_KEY:
                name = _source_of(part)
                streams[name] = _with_tasks(shifted.get(name) or reader.messages({part.topic}), part, tasks)
        self._messages = heapq.merge(*streams.values(), key=lambda item: item.received_ns)
        self._read: deque[Recorded] = deque(islice(self._messages, 1))
        """Read ahead, to know whether there is a message at or after a tick."""
        self._newest_ns = self.first_ns = self._read[0].received_ns if self._read else 0

    def __iter__(self) -> Iterator[tuple[str, Message, int]]:
        while self._read or self._read_on():
            recorded = self._read.popleft()
            yield recorded.topic, recorded.message, recorded.received_ns

    def ticks(self, step_ns: int) -> Iterator[int]:
        """Times of the ticks, from the first message to the last [ns]."""
        t_ns = self.first_ns
        while self._newest_ns >= t_ns or self._read_on():
            if self._newest_ns >= t_ns:
                yield t_ns
                t_ns += step_ns

    def _read_on(self) -> bool:
        recorded = next(self._messages, None)
        if recorded is None:
            return False
        if (silent_s := seconds(recorded.received_ns - self._newest_ns)) > _LONGEST_SILENCE_S:
            raise RecorderError(
                f"no topic of the contract has a message for {silent_s:.0f} s, from "
                f"{seconds(self._newest_ns - self.first_ns):.3f} s after the beginning; at most {_LONGEST_SILENCE_S} s "
                "are allowed: `ibrobot episodes trim` extracts the parts before and after"
            )
        self._read.append(recorded)
        self._newest_ns = recorded.received_ns
        return True


def frames(
    assembler: FrameAssembler, messages: Iterable[tuple[str, Message, int]], ticks: Iterable[int]
) -> Iterator[Frame]:
    """Frames from recorded messages: at each tick, bit for bit the frame that a live run would have had.

    Args:
        assembler: of the contract.
        messages: topic, message and time of receipt [ns], in the order of receipt, over all topics.
        ticks: the times of the frames [ns], ascending.

    Raises:
        ContractError: for messages out of the order of receipt, or one that does not fit the contract.
    """
    source = iter(messages)
    coming, last_ns = next(source, None), None
    for t_ns in ticks:
        while coming is not None and coming[2] <= t_ns:
            topic, message, received_ns = coming
            if last_ns is not None and received_ns < last_ns:
                came = f"{topic} at {received_ns} ns came after {last_ns} ns"
                raise ContractError(f"messages must come in the order of receipt; {came}")
            assembler.take(topic, message, received_ns)
            coming, last_ns = next(source, None), received_ns
        yield assembler.frame(t_ns)


class Ticks:
    """The rows of an episode, from the first complete tick to the last message.

    A first complete tick later than `max_age` after the first message is the end of a gap.

    Args:
        reader: the episode.
        contract: observations, actions and rate.
        missing: `refuse`, `skip` or `hold`: how to treat a later tick with a missing observation.

    Raises:
        RecorderError: when a topic of the contract has no message.
    """

    def __init__(self, reader: EpisodeReader, contract: Contract, missing: str) -> None:
        summary = reader.summary()
        present = {topic for topic, each in summary.topics.items() if each.count}
        absent = [topic for topic in contract.topics if topic not in present]
        if absent:
            has = ", ".join(sorted(present)) or "none"
            raise RecorderError(f"no message of {', '.join(absent)}, which the contract needs; available: {has}")
        self._contract = with_action(contract)
        self._signals = frozenset(_source_of(part) for part in contract.signal_parts)
        self._missing = missing
        self._max_age_ns = ns(contract.max_age)
        self.tasks: list[str] = []
        """The texts of the task's topic; each row has an index into them."""
        self._source = _Source(reader, contract, self.tasks)
        self._assembler = FrameAssembler(self._contract)
        self.cuts: list[tuple[int, int]] = []
        """Where ticks were left out: the number of the row that follows, from 0, and how many ticks."""
        self.held = 0
        self.gaps = Counter[str]()
        """Key -> how often it went missing."""
        self.rows = 0
        """Number of rows so far."""
        self.stamp_ns = 0
        """Time of the last row [ns]."""

    @property
    def skipped(self) -> int:
        """Number of incomplete ticks left out."""
        return sum(count for _, count in self.cuts)

    @property
    def lacks_end(self) -> bool:
        """Whether more than `max_age` of ticks is left out after the last row, so that the rows end too early."""
        row, count = self.cuts[-1] if self.cuts else (0, 0)
        return row == self.rows and count * self._contract.step_ns > self._max_age_ns

    @property
    def resets(self) -> Mapping[str, int]:
        """Topic -> number of jumps of its stamps, where there are any; without signals, which may pause."""
        return {topic: count for topic, count in self._assembler.resets().items() if topic not in self._signals}

    def __iter__(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Key -> value of each row; once.

        Raises:
            RecorderError: when an observation is missing at every tick, or with `refuse` at one.
            ContractError: for a message that does not fit the contract.
        """
        source, before = self._source, frozenset[str]()
        last: dict[str, NDArray[Any]] = {}
        leading: list[_Incomplete] = []
        over: list[int] = []
        for frame in frames(self._assembler, source, source.ticks(self._contract.step_ns)):
            if any(each.is_over(frame.stamp_ns) for each in source.following):
                over.append(frame.stamp_ns)
                continue
            far = any(each.is_silent(frame.stamp_ns) for each in source.following)
            missing = frame.missing | ({ACTION} if far else set())
            if not last:
                if missing:
                    leading.append((frame.stamp_ns, missing))
                    continue
                self._begin_late(leading, frame.stamp_ns)
            self.gaps.update(sorted(missing - before))  # equal episodes give equal bytes
            before = missing
            if missing and not self._take(missing, frame.stamp_ns):
                continue
            last = {**last, **frame.values}
            self.rows += 1
            self.stamp_ns = frame.stamp_ns
            yield last
        if not last:
            raise RecorderError(f"no tick has every observation and action: {self._never(leading)}")
        if over and any(each.ends_early(over[-1]) for each in source.following):
            self._leave_out([ACTION], over[0], len(over))

    def _begin_late(self, leading: Sequence[_Incomplete], t_ns: int) -> None:
        """Count the ticks before the first complete one, at `t_ns` [ns], if it is late: later than `max_age`."""
        late_ns = self._source.first_ns + self._max_age_ns
        if t_ns > late_ns:
            late = [missing for stamp_ns, missing in leading if stamp_ns > late_ns] or [leading[-1][1]]
            self._leave_out(sorted(frozenset.union(*late)), leading[0][0], len(leading))

    def _leave_out(self, keys: Sequence[str], t_ns: int, count: int) -> None:
        """Leave out `count` ticks from `t_ns` [ns] at the beginning or end, where no value can be held."""
        if self._missing == "refuse":
            self._refuse(keys, t_ns)
        self.gaps.update(keys)
        self._cut(count)

    def _take(self, missing: frozenset[str], t_ns: int) -> bool:
        """Whether a tick with a missing observation gives a row."""
        if self._missing == "refuse":
            self._refuse(sorted(missing), t_ns)
        if self._missing == "skip":
            self._cut(1)
            return False
        self.held += 1
        return True

    def _cut(self, count: int) -> None:
        """Leave out `count` ticks before the next row."""
        before = self.cuts.pop()[1] if self.cuts and self.cuts[-1][0] == self.rows else 0
        self.cuts.append((self.rows, before + count))

    def _refuse(self, keys: Sequence[str], t_ns: int) -> NoReturn:
        raise RecorderError(
            f"{', '.join(keys)} is missing {seconds(t_ns - self._source.first_ns):.3f} s after the beginning; "
            "--missing skip leaves such ticks out, --missing hold repeats the last value"
        )

    def _never(self, leading: Sequence[_Incomplete]) -> str:
        """Why no tick was complete."""
        absent = frozenset.intersection(*(missing for _, missing in leading)) if leading else frozenset()
        if not absent:
            return "a different one was missing each time"
        return (
            f"{', '.join(sorted(absent))} is missing at every tick (contract.max_age limits the age of held values to "
            f"{self._contract.max_age:g} s)"
        )


def _text_at(message: Message, part: SignalPart) -> str:
    """The text of a signal."""
    value = part.value(message)
    if isinstance(value, str):
        return value
    there = f"; available: {', '.join(attrs.fields_dict(type(value)))}" if attrs.has(type(value)) else ""
    raise ContractError(f"{part.path!r} is not a text in a {message.ros_type}{there}")
