"""The plugin's hooks: reads and writes LeRobot datasets without LeRobot or torch, and runs LeRobot policies."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ibrobot_provenance.datasets import DatasetDescriptor

from ibrobot_core.api import Check, Late, PolicyDescriptor, ReaderDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_lerobot.contents import Contents
from ibrobot_lerobot.options import LeRobotOptions, LeRobotPolicyOptions
from ibrobot_lerobot.training import EVENTS, check_trainer


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


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot datasets …`, `ibrobot export` and `ibrobot train`."""
    commands = "ibrobot_lerobot.commands"
    yield Command("datasets", summary="Show, join, upload and download LeRobot datasets.")
    yield Command("datasets info", Late(f"{commands}:ShowDataset"), "Show what a dataset contains.", (Contents,))
    yield Command("datasets merge", Late(f"{commands}:Merge"))
    yield Command("datasets push", Late(f"{commands}:Push"))
    yield Command("datasets pull", Late(f"{commands}:Pull"))
    yield Command("export", Late(f"{commands}:Export"), "Convert a checkpoint to run without torch.")
    train = Late("ibrobot_lerobot.train:Train")
    yield Command("train", train, "Train a policy with LeRobot.", EVENTS, check=check_trainer)
