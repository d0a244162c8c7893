"""Who commanded the robot at each row of an episode, and which rows a conversion keeps."""

from __future__ import annotations

import json
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter

from ibrobot_provenance.recorded_names import COMMANDER, OPERATOR, POLICY

from ibrobot_core.api import EpisodeReader, EpisodeSummary, RecorderError, String
from ibrobot_data.options import PLANNER


def is_labelled(summary: EpisodeSummary) -> bool:
    """Whether the episode records who commanded."""
    topic = summary.topics.get(COMMANDER)
    return topic is not None and topic.count > 0


class Commanders:
    """Who commands an episode's robot, by time.

    An episode of a mode without takeovers has one commander: the operator of its devices, its planner, or its policy.

    Raises:
        RecorderError: if neither the messages nor the mode in the metadata say who commands.
    """

    def __init__(self, reader: EpisodeReader, summary: EpisodeSummary) -> None:
        self._changes: list[tuple[int, str]] = []
        """Times [ns] at which the commander changes, and the new one."""
        if is_labelled(summary):
            for item in reader.messages({COMMANDER}):
                assert isinstance(item.message, String)
                if not self._changes or item.message.data != self._changes[-1][1]:
                    self._changes.append((item.received_ns, item.message.data))
        else:
            self._changes = [(0, _of_mode(summary))]

    def at(self, t_ns: int) -> str:
        """Who commanded at `t_ns` [ns], by the newest message up to then."""
        return self._changes[max(0, bisect_right(self._changes, t_ns, key=itemgetter(0)) - 1)][1]


def _of_mode(summary: EpisodeSummary) -> str:
    try:
        mode = json.loads(summary.metadata["config"])["control_modes"][summary.metadata["mode"]]
        words = {"teleop": OPERATOR, "planner": PLANNER}
        return next((word for key, word in words.items() if mode.get(key) is not None), POLICY)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise RecorderError(
            f"it is unknown who commanded: the episode has no {COMMANDER}, and its metadata no mode of a robot YAML"
        ) from None


def stretches[T](rows: Iterable[T], wanted: Callable[[T], bool], context: int) -> Iterator[tuple[T, int, bool]]:
    """The wanted rows, and up to `context` rows before and after each stretch of them.

    Yields:
        A row, its number, and whether it begins a stretch.
    """
    before: deque[tuple[int, T]] = deque(maxlen=context)
    after, last = 0, -2
    for number, row in enumerate(rows):
        if wanted(row):
            after = context + 1
            for earlier, kept in before:
                yield kept, earlier, earlier != last + 1
                last = earlier
            before.clear()
        if after > 0:
            after -= 1
            yield row, number, number != last + 1
            last = number
        else:
            before.append((number, row))
