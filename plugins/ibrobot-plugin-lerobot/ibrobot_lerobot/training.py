"""What `ibrobot train` takes, and the events that it prints: its command line and forms for it derive from these."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any, override

import attrs
from ibrobot_provenance.work_options import on_option
from ibrobot_terminal.plural import counted

from ibrobot_core.api import MissingDependency, how_to_install, option
from ibrobot_core.app import Event, Shown

LEROBOT = "lerobot[dataset,training]"
SMALL = "small_act"
"""The policy of the tutorial: an ACT with 0.5 million parameters, for a CPU."""
AUTO = "auto"
POLICIES = {
    SMALL: "small ACT, for a CPU",
    "act": "ACT",
    "diffusion": "Diffusion",
    "smolvla": "SmolVLA",
    "vqbet": "VQ-BeT",
}


def find_trainer() -> str:
    """The program `lerobot-train`.

    Raises:
        MissingDependency: if LeRobot is not installed.
    """
    beside = Path(sys.executable).with_name("lerobot-train")
    program = str(beside) if beside.exists() else shutil.which("lerobot-train")
    if program is None:
        raise MissingDependency("LeRobot is not installed", remedy=how_to_install(LEROBOT))
    return program


def check_trainer() -> None:
    """Check that training is possible on this machine.

    Raises:
        MissingDependency: as `find_trainer`.
    """
    find_trainer()


def _matches(pattern: str, example: str) -> Any:
    compiled = re.compile(pattern)

    def check(instance: object, attribute: object, value: str) -> None:
        if compiled.fullmatch(value) is None:
            raise ValueError(f"{value!r} is not a name such as {example}")

    return check


def _check_each(instance: object, attribute: object, each: tuple[str, ...]) -> None:
    for text in each:
        if not re.fullmatch(r"[A-Za-z][\w.]*=[^,=/\s]+(,[^,=/\s]+)*", text):
            raise ValueError(f"{text!r} is no option with values; give e.g. seed=1,2,3")


@attrs.frozen(kw_only=True)
class TrainOptions:
    """What is trained, on what and how long."""

    dataset: Path = option(typed="DATASET", names="dataset", label="Dataset", help="dataset to train on")
    lerobot_options: tuple[str, ...] = option(
        (), typed="LEROBOT_OPTIONS", names="options", label=None, help="further options, e.g. --seed=1"
    )
    policy: str = option(
        SMALL,
        choices=POLICIES,
        open=True,
        validator=_matches(r"[A-Za-z]\w*", "act"),
        label="Policy",
        help="a policy type of LeRobot, or small_act",
    )
    out: Path = option(
        suggest="training/{dataset}", label="Folder", help="folder for the checkpoints; a training in it is continued"
    )
    steps: int = option(5000, ge=1, le=100_000_000, label="Steps", help="steps of the training")
    batch_size: int = option(32, ge=1, le=1_000_000, label="Frames per step", help="size of the batches")
    device: str = option(
        AUTO,
        choices=(AUTO, "cpu", "cuda", "mps"),
        open=True,
        validator=_matches(r"[a-z]+(:\d+)?", "cuda:0"),
        label="Device",
        help="device of torch; auto: a GPU if there is one",
    )
    save_every: int | None = option(
        None,
        ge=1,
        label="Steps between checkpoints",
        more=True,
        help="steps between checkpoints; by default a tenth of all",
    )
    download: bool = option(
        False, label="Download weights", more=True, help="let LeRobot download the weights that the policy begins with"
    )
    each: tuple[str, ...] = option(
        (), label=None, unit="option=value,value", validator=_check_each,
        help="train once for each value of an option of LeRobot, e.g. seed=1,2,3; repeatable, for all combinations",
    )  # fmt: skip
    jobs: int | None = option(
        None, ge=1, label=None, help="trainings at once; by default one on this machine, or as many as a cluster can"
    )
    on: str = on_option()


@attrs.frozen
class Begin(Event):
    """The training begins."""

    step: int = option(help="step that it continues from; 0 for a new training")
    steps: int = option(help="steps in all")

    @override
    def shown(self) -> Shown:
        text = f"continues from step {self.step} of" if self.step else "begins:"
        return Shown(f"{text} {counted(self.steps, 'step')}", self.step / self.steps)


@attrs.frozen
class Phase(Event):
    """What the trainer does from now on."""

    text: str = option(help="what it does")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.text} …")


@attrs.frozen(kw_only=True)
class Progress(Event):
    """The state of the training."""

    step: int = option(help="present step")
    steps: int = option(help="steps in all")
    loss: float | None = option(help="loss of the present batch; null if it is not a finite number")
    lr: float | None = option(help="learning rate; null if unknown")
    seconds: float = option(unit="s", help="time since the begin")
    left_s: float | None = option(unit="s", help="estimate of the time left; null before there is one")

    @override
    def shown(self) -> Shown:
        loss = "not finite" if self.loss is None else f"{self.loss:.4g}"
        left = ""
        if self.left_s is not None:
            left = f", about {self.left_s / 60:.0f} min left" if self.left_s >= 60 else ", less than a minute left"
        point = {} if self.loss is None else {"step": float(self.step), "loss": self.loss}
        return Shown(f"step {self.step} of {self.steps}, loss {loss}{left}", self.step / self.steps, point=point)


@attrs.frozen
class Report(Event):
    """The result."""

    checkpoint: str = option(help="folder of the trained policy")

    @override
    def shown(self) -> Shown:
        return Shown(f"trained: {self.checkpoint}", 1.0, made={"policy": self.checkpoint})


EVENTS = (Begin, Phase, Progress, Report)
