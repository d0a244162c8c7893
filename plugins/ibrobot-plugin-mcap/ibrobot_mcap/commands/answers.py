"""`ibrobot episodes answers`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.screen import Screen
from numpy.typing import NDArray
from rich.table import Table

from ibrobot_core.api import (
    MODEL_ANSWERS,
    NS_PER_S,
    EpisodeReader,
    Float64MultiArray,
    ModelAnswer,
    RecorderError,
    option,
)
from ibrobot_core.app import wrong_input


@attrs.frozen(eq=False)
class Executed:
    """A request with its answer, and what became of it."""

    answer: ModelAnswer
    chunk: NDArray[np.float64]
    """The actions [rad], shape (N, J)."""
    count: int
    """Number of actions whose time came before the next chunk was used."""
    deviation: float | None
    """Largest difference between the commands of that time and the chunk [rad]; None without commands."""


@attrs.frozen(kw_only=True)
class ShowAnswers:
    """Show what a model was asked and answered.

    The table has a row for each request in the EPISODE, and what the robot executed of its chunk: from its arrival
    until the next one was used. Commands differ from it where chunks blend, and where a limit or an operator
    intervenes.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")

    @wrong_input()
    def __call__(self) -> list[dict[str, Any]]:
        from ibrobot_mcap.commands.find_episodes import opened

        with opened(self.episode) as reader:
            listed = [_json(each) for each in executed(reader)]
        if not listed:
            raise RecorderError(f"{self.episode}: has no answers of a model: {MODEL_ANSWERS} is missing or empty")
        return listed

    def show(self, listed: list[dict[str, Any]]) -> None:
        """Print a table, without the actions."""
        from ibrobot_mcap.commands.find_episodes import summary_of

        start_ns = summary_of(self.episode).start_ns
        console = Screen(width=None if sys.stdout.isatty() else 1000)
        table = Table(box=None, padding=(0, 1))
        for heading in (
            "request",
            "asked s",
            "ms",
            "model ms",
            "queue ms",
            "outcome",
            "actions",
            "executed",
            "rad off",
        ):
            table.add_column(heading, justify="left" if heading == "outcome" else "right")
        source = ""
        for each in listed:
            if source != (source := _source(each)):
                console.print(source, soft_wrap=True)
            table.add_row(
                str(each["request"]), f"{(each['observed_ns'] - start_ns) / NS_PER_S:.2f}",
                f"{each['latency_ms']:.0f}", f"{each['infer_ms']:.1f}", f"{each['queue_ms']:.1f}",
                f"{each['outcome']} {each['error']}".strip(), str(len(each["actions"])), str(each["executed"]),
                "" if each["deviation_rad"] is None else f"{each['deviation_rad']:.4f}",
            )  # fmt: skip
        console.print(table)


def executed(reader: EpisodeReader) -> Iterator[Executed]:
    """The requests of an episode, with what became of them, in the order of their answers."""
    from ibrobot_mcap.commands.plot import actions_of

    summary = reader.summary()
    joints_of = actions_of(summary.metadata, summary.topics)
    commands: dict[str, tuple[list[int], list[float]]] = {}
    """Joint -> times [ns] and positions [rad]."""
    kept: list[ModelAnswer] = []
    for item in reader.messages({MODEL_ANSWERS, *joints_of}):
        message = item.message
        if isinstance(message, ModelAnswer):
            kept.append(message)
        elif isinstance(message, Float64MultiArray):
            for joint, position in zip(joints_of[item.topic], message.data.tolist(), strict=False):
                times, positions = commands.setdefault(joint, ([], []))
                times.append(item.received_ns)
                positions.append(position)
    tracks = {joint: (np.array(times), np.array(positions)) for joint, (times, positions) in commands.items()}
    next_ns = _next_used(kept, summary.end_ns)
    for answer, until_ns in zip(kept, next_ns, strict=True):
        joints = answer.joint_names
        chunk = answer.actions.reshape(-1, len(joints)) if joints else np.empty((0, 0))
        times_ns = answer.observed_ns + np.arange(len(chunk)) * answer.step_ns
        begun_ns, used = answer.header.stamp_ns, answer.outcome == "used"
        count = int(((times_ns >= begun_ns) & (times_ns < until_ns)).sum()) if used else 0
        deviations = []
        for column, joint in enumerate(joints if used and len(chunk) else ()):
            if joint in tracks:
                at_ns, told = tracks[joint]
                chosen = (at_ns >= begun_ns) & (at_ns < min(until_ns, times_ns[-1]))
                planned = np.interp(at_ns[chosen] - times_ns[0], times_ns - times_ns[0], chunk[:, column])
                deviations += np.abs(told[chosen] - planned).tolist()
        yield Executed(answer, chunk, count, max(deviations, default=None))


def _next_used(in_order: Iterable[ModelAnswer], end_ns: int) -> list[int]:
    """For each answer, the time at which the next one was used, or the end [ns]."""
    times: list[int] = []
    next_ns = end_ns
    for answer in reversed([*in_order]):
        times.append(next_ns)
        if answer.outcome == "used":
            next_ns = answer.header.stamp_ns
    return times[::-1]


def _source(answer: Mapping[str, Any]) -> str:
    """The model of an answer, and the prompt of its request."""
    weights, prompt = answer["weights"], answer["prompt"]
    parts = [f"model {answer['model']}", answer["server"], f"weights {weights}" if weights else ""]
    return ", ".join(part for part in [*parts, f"prompt {prompt!r}" if prompt else ""] if part)


def _json(each: Executed) -> dict[str, Any]:
    document = attrs.asdict(each.answer, recurse=False)
    return {
        **document, "header": attrs.asdict(each.answer.header), "joint_names": list(each.answer.joint_names),
        "actions": each.chunk.tolist(), "executed": each.count, "deviation_rad": each.deviation,
    }  # fmt: skip
