"""The plugin's hooks: reader `rosbag2`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ibrobot_core.descriptors import ReaderDescriptor
from ibrobot_core.hookspecs import hookimpl

if TYPE_CHECKING:
    from ibrobot_core.interfaces import EpisodeReader


def _reads(path: Path) -> bool:
    from ibrobot_mcap.reader import is_rosbag2

    return is_rosbag2(path)


def _read(path: Path) -> EpisodeReader:
    from ibrobot_mcap.reader import Rosbag2Reader

    return Rosbag2Reader(path)


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """Bags of ROS 2."""
    yield ReaderDescriptor("rosbag2", "ROS 2 bags: MCAP, also unfinished, and sqlite3", _reads, _read)
