"""The plugin's hooks: reads and writes LeRobot datasets without LeRobot or torch, and runs LeRobot policies."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ibrobot_core.api import Check, DatasetDescriptor, Late, PolicyDescriptor, ReaderDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_lerobot.contents import Contents, InfoOptions
from ibrobot_lerobot.options import LeRobotOptions, LeRobotPolicyOptions
from ibrobot_lerobot.training import EVENTS, TrainOptions, check_trainer


def _reads(path: Path) -> bool:
    return (path / "meta" / "info.json").is_file()


def _is_checkpoint(path: Path) -> bool:
    return path.name == "pretrained_model" and (path / "config.json").is_file()


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """The writer of LeRobot datasets."""
    yield DatasetDescriptor(
        type="lerobot",
        options=LeRobotOptions,
        make=lambda options, ctx: Late("ibrobot_lerobot.writer:LeRobotDatasetWriter")(options),
        default=True,
        summary="LeRobot v3.0: videos and tables",
        flags=("codec", "crf", "videos"),
    )


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """The reader of LeRobot datasets."""
    yield ReaderDescriptor(
        "lerobot",
        "LeRobot datasets, v2.0 to v3.0, as DATASET:N",
        _reads,
        Late("ibrobot_lerobot.reader:LeRobotReader"),
        numbered=True,
    )


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """The policy that runs LeRobot checkpoints."""
    yield PolicyDescriptor(
        type="lerobot",
        options=LeRobotPolicyOptions,
        make=Late("ibrobot_lerobot.policy:LeRobotPolicy"),
        reads=_is_checkpoint,
        summary="a LeRobot checkpoint: ACT, Diffusion, VQ-BeT, SmolVLA, pi0, …",
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check LeRobot's version."""
    from ibrobot_lerobot.versions import check

    yield check()


_DATASETS = Late("ibrobot_lerobot.commands:datasets").load
INFO = Command("datasets info", "Show what a dataset contains.", _DATASETS, InfoOptions, (Contents,))
TRAIN = Command(
    "train",
    "Train a policy with LeRobot.",
    Late("ibrobot_lerobot.train:train").load,
    TrainOptions,
    EVENTS,
    check=check_trainer,
)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot datasets info`, `ibrobot export` and `ibrobot train`."""
    yield Command(
        "datasets",
        "Show, join, upload and download LeRobot datasets.",
        _DATASETS,
        commands=(INFO,),
    )
    yield Command("export", "Convert a checkpoint to run without torch.", Late("ibrobot_lerobot.commands:export").load)
    yield TRAIN
