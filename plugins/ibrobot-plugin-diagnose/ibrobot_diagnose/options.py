"""Options of `ibrobot explain`, and the events that it prints. Its command line and forms derive from these."""

from __future__ import annotations

from pathlib import Path
from typing import override

import attrs
from ibrobot_provenance.work_options import on_option
from ibrobot_terminal.plural import counted

from ibrobot_core.api import Options, documented, option
from ibrobot_core.app import Event, Shown

KIND = "explanation"
"""The kind of report, for pages."""
REPORT = "explanation.json"
CHECK_KIND = "check"
"""The kind of report on a dataset."""
CHECK = "check.json"
PREFLIGHT_KIND = "preflight"
"""The kind of report on a rig."""
PREFLIGHT = "preflight.json"


def _some(instance: object, attribute: object, paths: tuple[Path, ...]) -> None:
    if not paths:
        raise ValueError("choose at least one")


@attrs.frozen(kw_only=True)
class ExplainOptions:
    """Which runs are explained, and what they are compared with."""

    episodes: tuple[Path, ...] = option(
        typed="EPISODES", names="episodes", validator=_some, help="recorded runs of a policy, or folders of them"
    )
    data: Path | None = option(
        None, names="dataset", label="Data",
        help="the data that the model was trained on: a dataset, its episodes, or a folder or file with their card",
    )  # fmt: skip
    against: Path | None = option(
        None, names="episodes", label="Against", more=True,
        help="compare with this run, or the runs in this folder, in place of --data: what differs from one that worked",
    )  # fmt: skip
    model: str | None = option(
        None, label="Model", names="policy",
        help="ask the model again: its checkpoint's folder, or its name in the recorded YAML; `.`: the one that acted",
    )  # fmt: skip
    server: str | None = option(
        None, label="Server", more=True,
        help="with --model, ask the server at this address, which has the weights, e.g. tcp/gpu.lab:7447",
    )  # fmt: skip
    out: Path | None = option(
        None, label="Folder", suggest="explanations/{episodes}", help="folder for a report as HTML and JSON"
    )
    ticks: bool = option(False, label=None, help="with --json, add what happened at each tick")
    jobs: int | None = option(
        None, ge=1, label="Episodes at once", more=True, help="episodes in parallel; by default one for each CPU core"
    )
    on: str = on_option()


@attrs.frozen(kw_only=True)
class Progress(Event):
    """An episode is explained."""

    done: int = option(help="finished episodes")
    of: int = option(help="number of episodes")
    episode: str = option(help="the episode")
    first: str = option(help="the most probable cause in a sentence, or that none was found")
    error: str = option("", help="why it could not be explained; empty if it was")

    @override
    def shown(self) -> Shown:
        problem = f"{self.episode}: {self.error}" if self.error else ""
        done = f"{self.done} of {self.of} {'episode' if self.of == 1 else 'episodes'}"
        return Shown(f"{done}; {self.episode}: {self.first}", self.done / max(1, self.of), problem)


@attrs.frozen(kw_only=True)
class Report(Event):
    """The result."""

    out: str = option("", help="folder of the reports; empty without one")
    lines: tuple[str, ...] = option(help="the most probable cause of each episode")

    @override
    def shown(self) -> Shown:
        made = {KIND: self.out} if self.out and len(self.lines) == 1 else {}
        return Shown("\n".join(self.lines), 1.0, made=made)


EVENTS = (Progress, Report)


@attrs.frozen(kw_only=True)
class CheckOptions:
    """Which dataset is checked."""

    dataset: Path = option(
        typed="DATASET", names="dataset", label="Dataset", help="a LeRobot dataset, or a folder of recorded episodes"
    )
    least: float = option(
        0.5, ge=0.05, le=1, label="Likelihood", more=True, help="likelihood from which an episode is listed"
    )
    out: Path | None = option(
        None, label="Folder", suggest="checks/{dataset}", help="folder for a report as HTML and JSON, with pictures"
    )
    jobs: int | None = option(
        None, ge=1, label="Episodes at once", more=True, help="episodes in parallel; by default one for each CPU core"
    )
    on: str = on_option()


@attrs.frozen(kw_only=True)
class CheckProgress(Event):
    """An episode was read, or checked."""

    done: int = option(help="episodes read and checked")
    of: int = option(help="number of both")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.done} of {counted(self.of, 'step')}", self.done / max(1, self.of))


@attrs.frozen(kw_only=True)
class CheckReport(Event):
    """The result."""

    out: str = option("", help="folder of the report; empty without one")
    lines: tuple[str, ...] = option(help="the listed episodes with their reasons, worst first")

    @override
    def shown(self) -> Shown:
        return Shown("\n".join(self.lines[:3]), 1.0, made={CHECK_KIND: self.out} if self.out else {})


CHECK_EVENTS = (CheckProgress, CheckReport)


SECTION = "preflight"
"""The section of the robot YAML."""


@documented
@attrs.frozen
class PreflightSection(Options):
    """Options of the section `preflight`."""

    against: Path | None = option(
        None, help="the reference; none: that of the recording's dataset, or of the mode's checkpoint"
    )
    action: str = option(
        "warn",
        choices=("warn", "refuse", "off"),
        help="what a difference does: warn logs it; refuse ends the run before anything moves if a line fails; off "
        "compares nothing",
    )
    seconds: float = option(1.0, unit="s", ge=0.5, le=10, help="length of the window")


@attrs.frozen(kw_only=True)
class PreflightOptions:
    """Which rig is looked at, and what it is compared with."""

    robot: str | None = option(None, typed="ROBOT", names="robot", label="Robot", help="robot YAML")
    against: Path | None = option(
        None, names="dataset", label="Against", open=True,
        help="the reference: one that was taken, or a dataset or checkpoint with its card",
    )  # fmt: skip
    take: Path | None = option(None, typed="--take FILE", label="Take", help="write a reference to this file")
    sim: bool = option(False, label="Simulated", help="use the simulation section instead of hardware")
    mode: str | None = option(None, typed="--mode MODE", label=None, help="in place of default_control_mode")
    seconds: float = option(3.0, ge=0.5, le=10, unit="s", label="Duration", more=True, help="length of the window")
    lockstep: bool = option(False, label=None, help="look in simulated time; the loop's rate is then not measured")
    overrides: tuple[str, ...] = option((), typed="--set PATH=VALUE", label=None, help="e.g. control.rate_hz=50")
    out: Path | None = option(
        None, label="Folder", suggest="preflights/{robot}", help="folder for a report as HTML and JSON, with pictures"
    )


@attrs.frozen(kw_only=True)
class Looking(Event):
    """The rig is looked at."""

    what: str = option(help="what begins now")

    @override
    def shown(self) -> Shown:
        return Shown(self.what)


@attrs.frozen(kw_only=True)
class Difference(Event):
    """Something is not as in the reference."""

    name: str = option(help="the cause")
    verdict: str = option(help="warn or fail")
    text: str = option(help="what differs, in a sentence")
    limits: str = option(help="the number, and the thresholds for a warning and a failure")
    remedy: str = option(help="what to do")

    @override
    def shown(self) -> Shown:
        return Shown("", problem=f"{self.text} {self.limits}\nWhat to do: {self.remedy}")


@attrs.frozen(kw_only=True)
class PreflightReport(Event):
    """The result."""

    verdict: str = option(help="ok, warn or fail")
    lines: tuple[str, ...] = option(help="a line for each thing compared, worst first")
    out: str = option("", help="folder of the report; empty without one")

    @override
    def shown(self) -> Shown:
        made = {PREFLIGHT_KIND: self.out} if self.out else {}
        return Shown(self.lines[-1] if self.lines else self.verdict, 1.0, made=made)


PREFLIGHT_EVENTS = (Looking, Difference, PreflightReport)
