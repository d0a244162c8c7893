"""Options of `ibrobot identify`, and the events that it prints; importing them imports neither MuJoCo nor SciPy."""

from __future__ import annotations

from pathlib import Path
from typing import override

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import NORM_MODES, Event, Shown

KIND = "identification"
"""The kind of report, for pages."""
REPORT = "identification.json"


@attrs.frozen(kw_only=True)
class IdentifyOptions:
    """Which recordings, of which arm."""

    episodes: tuple[Path, ...] = option(
        (), typed="EPISODES", names="episodes", label="Recordings",
        help="recordings of the arm, or folders of them; together some five minutes",
    )  # fmt: skip
    robot: str | None = option(
        None, names="robot", label="Robot", help="robot YAML of the arm; by default the recorded one"
    )
    out: Path | None = option(
        None, label="Folder", suggest="identified/{episodes}",
        help="folder for the file of parameters, parameters.yaml, and a report as HTML and JSON",
    )  # fmt: skip
    last: Path | None = option(
        None, typed="--against FILE", label="Compare with", more=True,
        help="an earlier file of parameters, from which changes are named; by default that of the robot YAML",
    )  # fmt: skip
    rotations: int = option(
        1, ge=1, le=20, label="Rotations", more=True,
        help="how often another part is held out, on which the error is measured; each takes a fit of its own",
    )  # fmt: skip
    norm_mode: str | None = option(
        None, choices=NORM_MODES, label="Unit", more=True, help="unit of joints in a dataset that does not state it"
    )
    calibration: str | None = option(
        None, typed="--calibration NAME", names="calibration", label="Calibration", more=True,
        help="calibration for such a dataset, if its unit needs one",
    )  # fmt: skip
    excite: str | None = option(
        None, typed="--excite ROBOT", names="robot", label="Or move a robot",
        help="instead: move this robot so that all can be found, within its limits and guard, and record it; it needs "
        "free space around it, and nothing in its gripper",
    )  # fmt: skip
    minutes: float = option(
        5.0, ge=0.5, le=15, unit="min", label="Duration", more=True, help="about how long the motion takes"
    )
    dataset: str = option("excitation", label="Dataset", more=True, help="dataset into which the motion is recorded")
    sim: bool = option(False, label="Simulated", help="move the simulated robot in place of the real one")
    lockstep: bool = option(False, label=None, help="with --excite --sim, run in simulated time")
    viewer: str | None = option(
        None, typed="--viewer TYPE", names="viewer", label=None, help="with --excite, show the robot in it"
    )
    headless: bool = option(False, label=None, help="with --excite, print plain lines, without window and panel")
    seed: int = option(0, label=None, help="with --excite, of the poses")
    overrides: tuple[str, ...] = option((), typed="--set PATH=VALUE", label=None, help="e.g. simulation.timestep=0.001")


@attrs.frozen(kw_only=True)
class IdentifyProgress(Event):
    """What is done now."""

    what: str = option(help="what begins")
    share: float = option(help="about which share of the work is done, 0 to 1")

    @override
    def shown(self) -> Shown:
        return Shown(self.what, min(1.0, self.share))


@attrs.frozen(kw_only=True)
class IdentifyReport(Event):
    """The result."""

    out: str = option("", help="folder of the report; empty without one")
    lines: tuple[str, ...] = option(help="the result, in lines")

    @override
    def shown(self) -> Shown:
        return Shown("; ".join(self.lines[:3]), 1.0, made={KIND: self.out} if self.out else {})


@attrs.frozen(kw_only=True)
class Excited(Event):
    """The robot has moved, and was recorded."""

    dataset: str = option(help="folder of the recording")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.dataset}: recorded; now identify from it", 1.0, made={"episodes": self.dataset})


EVENTS = (IdentifyProgress, Excited, IdentifyReport)
