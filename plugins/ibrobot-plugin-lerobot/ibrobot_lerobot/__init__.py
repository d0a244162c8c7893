"""The plugin's hook: dataset writer `lerobot`, LeRobot v3 without LeRobot and torch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import DatasetDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_lerobot.options import LeRobotOptions

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, DatasetWriter


def _write(options: Any, ctx: Context) -> DatasetWriter:
    from ibrobot_lerobot.writer import LeRobotDatasetWriter

    return LeRobotDatasetWriter(options)


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """What writes datasets that LeRobot trains on."""
    yield DatasetDescriptor(
        type="lerobot", options=LeRobotOptions, make=_write, summary="LeRobot v3.0: videos and tables"
    )
