"""The plugin's hooks: writer and reader of LeRobot v3 datasets, without LeRobot and torch."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import DatasetDescriptor, ReaderDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_lerobot.options import LeRobotOptions

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, DatasetWriter, EpisodeAddress, EpisodeReader


def _write(options: Any, ctx: Context) -> DatasetWriter:
    from ibrobot_lerobot.writer import LeRobotDatasetWriter

    return LeRobotDatasetWriter(options)


def _reads(path: Path) -> bool:
    return (path / "meta" / "info.json").is_file()


def _read(address: EpisodeAddress) -> EpisodeReader:
    from ibrobot_lerobot.reader import LeRobotReader

    return LeRobotReader(address)


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """What writes datasets that LeRobot trains on."""
    yield DatasetDescriptor(
        type="lerobot", options=LeRobotOptions, make=_write, summary="LeRobot v3.0: videos and tables"
    )


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """What reads episodes of datasets."""
    yield ReaderDescriptor("lerobot", "LeRobot v3.0 datasets, as DATASET:N", _reads, _read, numbered=True)
