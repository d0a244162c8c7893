"""Options of `ibrobot eval`, and the events that it prints. Its command line and forms derive from these."""

from __future__ import annotations

from pathlib import Path
from typing import override

import attrs
from ibrobot_provenance.asking import Ask
from ibrobot_provenance.work_options import on_option, shard_of, shard_option
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import Event, Shown

SETTINGS = "evaluation.json"
"""File in the folder of an evaluation with its settings."""
REPORT = "report.json"
KIND = "evaluation"
"""The kind of report, for pages."""
MARGIN = 0.1
"""Default of the margin: a smaller difference of success rates counts as none."""


@attrs.frozen(kw_only=True)
class EvalOptions:
    """Which policies are evaluated, on how many episodes, and where the results go."""

    config: tuple[str, ...] = option(typed="CONFIG", names="robot", label="Robot YAML", help="robot YAMLs")
    mode: tuple[str, ...] = option((), label="Modes", help="a control mode with a policy; repeatable")
    model: tuple[str, ...] = option(
        (), label="Models", more=True, help="a model of the YAML, in place of the mode's; repeatable"
    )
    sim: bool = option(False, label="Simulation", help="use the simulation section instead of hardware")
    episodes: int = option(
        100, ge=1, le=1_000_000, label="Episodes", help="episodes of each policy; the largest number with until-decided"
    )
    seed: int = option(0, ge=0, label="Seed", more=True, help="seed of the first episode; later ones add 1")
    vary: tuple[str, ...] = option(
        (),
        label="Vary",
        more=True,
        unit="path=low:high:count",
        help="vary a key of the YAML over the episodes, e.g. simulation.scene.light=0.2:1.5:5; repeatable",
    )
    until_decided: bool = option(False, label="Until decided", help="stop as soon as every pair of policies is decided")
    margin: float = option(
        MARGIN, gt=0, lt=1, label="Margin", more=True, help="a difference of success rates below this counts as none"
    )
    jobs: int | None = option(
        None, ge=1, label="Episodes at once", more=True, help="episodes in parallel; by default one for each CPU core"
    )
    on: str = on_option()
    shard: str = shard_option()
    videos: int = option(20, ge=0, label="Videos", more=True, help="failures of each policy to film for the report")
    all_pictures: bool = option(
        False,
        label="All pictures",
        more=True,
        help="also record the cameras that the policy does not look at; rendering them takes most of the time",
    )
    answer_limit: float = option(
        120.0,
        gt=0,
        unit="s",
        label="Longest answer",
        more=True,
        help="an episode in which the policy takes longer for an answer, in real time, is an error",
    )
    episode_limit: float = option(
        3600.0,
        gt=0,
        unit="s",
        label="Longest episode",
        more=True,
        help="an episode that takes longer, in real time, is an error",
    )
    trials: bool = option(
        False, label="Blinded trials", help="run blinded trials, as on a real arm, with a simulated one"
    )
    reset_task: Path | None = option(
        None, label="Reset task", more=True, help="blinded trials: perform this task before each of them"
    )
    reset: str = option("", unit="command", label=None, help="blinded trials: run this command before each of them")
    open: bool = option(
        False, label="Open the order", more=True, help="blinded trials: open the order now; no trial can follow"
    )
    out: Path = option(
        suggest="evaluations/{config}",
        label="Folder",
        help="folder of results, recordings and report; an evaluation in it is continued",
    )

    @property
    def seeds(self) -> range:
        """Seeds of the episodes: all, or those of the shard."""
        part = shard_of(self.shard, self.episodes)
        return range(self.seed + part.start, self.seed + part.stop)


def outcome_of(success: bool, error: str) -> str:
    """The outcome of an episode in words."""
    return "success" if success else f"error: {error}" if error else "failure"


@attrs.frozen(kw_only=True)
class Begin(Event):
    """The evaluation begins."""

    of: int = option(help="number of episodes of all policies")
    done: int = option(help="episodes that earlier calls have finished")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.done} of {counted(self.of, 'episode')}", self.done / self.of)


@attrs.frozen(kw_only=True)
class Progress(Event):
    """An episode has finished."""

    done: int = option(help="finished episodes")
    of: int = option(help="number of episodes of all policies")
    policy: str = option(help="the policy")
    seed: int = option(help="seed of the episode")
    success: bool = option(help="whether it succeeded")
    time_s: float = option(unit="s", help="its duration in simulated time")
    error: str = option(help="what the policy did wrong besides acting badly; empty if nothing")
    seconds: float = option(unit="s", help="time since the evaluation began")

    @override
    def shown(self) -> Shown:
        outcome = outcome_of(self.success, self.error)
        text = f"{self.done} of {counted(self.of, 'episode')}; {self.policy}, seed {self.seed}: {outcome}"
        return Shown(text, self.done / self.of)


@attrs.frozen(kw_only=True)
class Told(Event):
    """A message for the operator of blinded trials."""

    text: str = option(help="the text")

    @override
    def shown(self) -> Shown:
        return Shown(self.text)


@attrs.frozen(kw_only=True)
class Report(Event):
    """The result."""

    out: str = option(help="folder of the evaluation")
    lines: tuple[str, ...] = option(help="successes of each policy, and the verdict on each pair, in words")

    @override
    def shown(self) -> Shown:
        return Shown("; ".join(self.lines), 1.0, made={KIND: self.out})


EVENTS = (Begin, Progress, Ask, Told, Report)
