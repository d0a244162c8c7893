"""Rows of an episode: observations and the action in effect, at the contract's ticks, by the shared aligner."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

import attrs
from numpy.typing import NDArray

from ibrobot_core.config.schema import Align
from ibrobot_core.contract.frames import FrameAssembler, assemble
from ibrobot_core.contract.specs import Contract, ObservationPart
from ibrobot_core.errors import RecorderError
from ibrobot_core.interfaces import EpisodeReader, Feature, Recorded
from ibrobot_core.messages import Message
from ibrobot_core.units import seconds

ACTION = "action"
_LONGEST_SILENCE_S = 60
"""Without a message of any topic [s]; a damaged stamp would otherwise make rows for years."""
_COMMAND = Align("hold", "receive")
"""The command in effect at a tick is the newest that was sent by then, however old."""


def with_action(contract: Contract) -> Contract:
    """The contract whose observations include the action: what the executors were told, read back from their topics.

    A row has the command in effect at its tick. What a policy learns from it is what the robot was following when
    it saw the observation, the safety layer's limits included; at the control rate that command is one control
    period old at most.
    """
    features = {part.topic: Feature("float32", (len(part.joints),)) for part in contract.action_parts}
    parts = tuple(
        ObservationPart(ACTION, part.topic, part.type, part.select or ("data",), None, _COMMAND, features[part.topic])
        for part in contract.action_parts
    )
    return attrs.evolve(contract, observation_parts=(*contract.observation_parts, *parts), action_parts=())


class _Source:
    """An episode's messages, and the ticks from the first to the last of them."""

    def __init__(self, reader: EpisodeReader, contract: Contract) -> None:
        self._messages = reader.messages(contract.topics)
        self._read: deque[Recorded] = deque(islice(self._messages, 1))
        """Read ahead, to know whether there is a message at or after a tick."""
        self._newest_ns = self.first_ns = self._read[0].received_ns if self._read else 0

    def __iter__(self) -> Iterator[tuple[str, Message, int]]:
        while self._read or self._read_on():
            recorded = self._read.popleft()
            yield recorded.topic, recorded.message, recorded.received_ns

    def ticks(self, step_ns: int) -> Iterator[int]:
        """From the first message to the last."""
        t_ns = self.first_ns
        while self._newest_ns >= t_ns or self._reaches(t_ns):
            yield t_ns
            t_ns += step_ns

    def _reaches(self, t_ns: int) -> bool:
        while self._read_on():
            if self._newest_ns >= t_ns:
                return True
        return False

    def _read_on(self) -> bool:
        recorded = next(self._messages, None)
        if recorded is None:
            return False
        if (silent_s := seconds(recorded.received_ns - self._newest_ns)) > _LONGEST_SILENCE_S:
            raise RecorderError(
                f"no message of the contract comes for {silent_s:.0f} s, from "
                f"{seconds(self._newest_ns - self.first_ns):.3f} s after the beginning on; at most "
                f"{_LONGEST_SILENCE_S} s may pass: `ibrobot episodes trim` takes the parts before and after"
            )
        self._read.append(recorded)
        self._newest_ns = recorded.received_ns
        return True


class Ticks:
    """The rows of an episode, from the first tick at which everything is there to the last message.

    Args:
        reader: the episode.
        contract: observations, actions and rate.
        missing: `refuse`, `skip` or `hold`; what a later tick is worth at which something is missing.

    Raises:
        RecorderError: when a topic of the contract has no message.
    """

    def __init__(self, reader: EpisodeReader, contract: Contract, missing: str) -> None:
        summary = reader.summary()
        present = {topic for topic, each in summary.topics.items() if each.count}
        absent = [topic for topic in contract.topics if topic not in present]
        if absent:
            has = ", ".join(sorted(present)) or "none"
            raise RecorderError(f"no message of {', '.join(absent)}, which the contract has; there are: {has}")
        self._contract = with_action(contract)
        self._missing = missing
        self._source = _Source(reader, contract)
        self._assembler = FrameAssembler(self._contract)
        self.skipped = 0
        self.held = 0
        self.gaps: dict[str, int] = {}
        """Key -> how often it went missing."""

    @property
    def resets(self) -> Mapping[str, int]:
        """How often the stamps of a topic jumped, per topic; topics without a jump left out."""
        return self._assembler.resets()

    def __iter__(self) -> Iterator[dict[str, NDArray[Any]]]:
        """Key -> value of each row; once.

        Raises:
            RecorderError: when something is missing and that is to be refused, or is missing all the time.
            ContractError: for a message that does not fit the contract.
        """
        source, before = self._source, frozenset[str]()
        last: dict[str, NDArray[Any]] = {}
        absent = frozenset(self._contract.observations)
        for frame in assemble(self._assembler, source, source.ticks(self._contract.step_ns)):
            if not last:
                absent &= frame.missing
                if frame.missing:
                    continue
            for key in frame.missing - before:
                self.gaps[key] = self.gaps.get(key, 0) + 1
            before = frame.missing
            if frame.missing and not self._take(frame.missing, frame.stamp_ns):
                continue
            last = {**last, **frame.values}
            yield last
        if not last:
            what = f"{', '.join(sorted(absent))} is missing at every one" if absent else "each time another was missing"
            raise RecorderError(f"there is no tick at which every observation and action is there: {what}")

    def _take(self, missing: frozenset[str], t_ns: int) -> bool:
        """Whether a tick at which something is missing gives a row."""
        if self._missing == "refuse":
            at_s = seconds(t_ns - self._source.first_ns)
            raise RecorderError(
                f"{', '.join(sorted(missing))} is missing {at_s:.3f} s after the beginning; "
                "--missing skip leaves such ticks out, --missing hold takes the last value"
            )
        if self._missing == "skip":
            self.skipped += 1
            return False
        self.held += 1
        return True
