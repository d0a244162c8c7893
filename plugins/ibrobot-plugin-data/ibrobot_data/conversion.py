"""Options of `ibrobot convert`, and the events that it prints. Its command line and forms derive from these."""

from __future__ import annotations

from pathlib import Path
from typing import override

import attrs
from ibrobot_provenance.work_options import on_option, shard_option
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import NORM_MODES, Event, Shown

OUTCOMES = {"success": "successful", "failure": "failed", "unknown": "not judged"}
MISSING = {"refuse": "leave the episode out", "skip": "leave the tick out", "hold": "repeat the last value"}
ONLY = {"all": "all", "interventions": "commanded by the operator", "policy": "commanded by the policy"}
_UNITS = ("radians", "degrees, as LeRobot's drivers", "-100 to 100, as LeRobot's drivers")
UNITS = dict(zip(NORM_MODES, _UNITS, strict=True))


def _some(instance: object, attribute: object, paths: tuple[Path, ...]) -> None:
    if not paths:
        raise ValueError("choose at least one")


@attrs.frozen(kw_only=True)
class ConvertOptions:
    """Which episodes are converted into which dataset, and how."""

    episodes: tuple[Path, ...] = option(
        typed="EPISODES", names="episodes", validator=_some, help="episodes, or folders of them"
    )
    out: Path = option(
        names="dataset", open=True, suggest="datasets/{episodes}", label="Dataset", help="folder of the dataset"
    )
    append: bool = option(False, label="Add to it", help="add new episodes to an existing dataset")
    outcome: tuple[str, ...] = option(
        tuple(OUTCOMES), choices=OUTCOMES, label="Outcomes", help="episodes to convert", suggest="success"
    )
    prompt: str = option("", label="Task", help="task of episodes that were recorded without one")
    only: str = option(
        "all", choices=ONLY, label="Rows", more=True, help="rows to keep; each stretch of them becomes an episode"
    )
    context: float = option(
        2.0,
        ge=0,
        unit="s",
        label="Around interventions",
        more=True,
        help="time to keep before and after an intervention, if only interventions are kept",
    )
    missing: str = option(
        "skip",
        choices=MISSING,
        label="Missing observations",
        more=True,
        help="what to do if an observation is missing at a tick",
    )
    norm_mode: str | None = option(
        None,
        choices=UNITS,
        label="Unit of joints",
        more=True,
        help="unit of the dataset's joints; by default radians, or that of the dataset with --to bag",
    )
    units: str | None = option(
        None, label=None, help="type of what converts to this unit; needed if several plugins offer a default"
    )
    success: bool = option(
        False, label="Add next.success", more=True, help="add a feature that is true in the last row of a success"
    )
    any_robot: bool = option(
        False, label="Any robot", more=True, help="merge episodes of different robots, robot types or calibrations"
    )
    config: str | None = option(
        None,
        names="robot",
        label="Robot YAML",
        more=True,
        help="robot YAML, or a YAML with only a contract, for episodes of other programs",
    )
    force_contract: bool = option(
        False,
        label="Contract of the YAML",
        more=True,
        help="use the contract of the YAML even if the recorded one differs",
    )
    calibration: str | None = option(
        None, names="calibration", label="Calibration", more=True, help="calibration to use instead of the recorded one"
    )
    anchored: str | None = option(
        None,
        label="Joints from 0 to 100",
        more=True,
        help="with a calibration: names of joints that range from 0 to 100, separated by commas; by default those of "
        "the robot YAML's hardware",
    )
    jobs: int | None = option(
        None, ge=1, label="Episodes at once", more=True, help="episodes in parallel; by default one for each CPU core"
    )
    on: str = on_option()
    shard: str = shard_option()


@attrs.frozen
class Begin(Event):
    """The conversion begins."""

    of: int = option(help="number of episodes")

    @override
    def shown(self) -> Shown:
        return Shown(f"0 of {counted(self.of, 'episode')}", 0.0)


@attrs.frozen(kw_only=True)
class Progress(Event):
    """Progress of the conversion."""

    done: int = option(help="finished episodes")
    of: int = option(help="number of episodes")
    frames: int = option(help="finished frames")
    total_frames: int = option(help="estimated number of frames")
    seconds: float = option(unit="s", help="time since the conversion began")
    episode: str = option("", help="the episode that finished with this event, if any")
    error: str = option("", help="why it is left out; empty if it was converted")

    @override
    def shown(self) -> Shown:
        text = f"{self.done} of {counted(self.of, 'episode')}, {counted(self.frames, 'frame')}, {self.seconds:.0f} s"
        problem = f"{self.episode} is left out: {self.error}" if self.error else ""
        return Shown(text, min(1.0, self.frames / max(1, self.total_frames)), problem)


@attrs.frozen(kw_only=True)
class Report(Event):
    """The result."""

    out: str = option(help="the dataset")
    episodes: int = option(help="episodes that were added")
    frames: int = option(help="their frames")
    failed: int = option(help="episodes left out because of an error")
    passed_over: int = option(help="episodes not selected, or already in the dataset")
    resumed: int = option(help="episodes converted by an interrupted run")
    skipped_ticks: int = option(help="ticks left out because an observation was missing")
    held_ticks: int = option(help="ticks with a repeated observation")
    gaps: int = option(help="how often an observation went missing")
    lost_messages: int = option(help="messages that the recorder lost")
    resets: int = option(help="stamps that jumped")
    without_prompt: int = option(help="episodes without a task")
    size_bytes: int = option(unit="bytes", help="size of the whole dataset")
    seconds: float = option(unit="s", help="duration")

    @override
    def shown(self) -> Shown:
        counts = {
            "left out": self.failed,
            "passed over": self.passed_over,
            "ticks skipped": self.skipped_ticks,
            "ticks held": self.held_ticks,
            "messages lost in recording": self.lost_messages,
            "without a task": self.without_prompt,
        }
        others = "".join(f", {name} {count}" for name, count in counts.items() if count)
        text = f"{counted(self.episodes, 'episode')}, {counted(self.frames, 'frame')}{others}"
        made = {"dataset": self.out} if self.episodes else {}
        return Shown(f"{text}; the dataset has {self.size_bytes / 1e6:.1f} MB", 1.0, made=made)


EVENTS = (Begin, Progress, Report)
