"""The plugin's hooks: recorder `mcap`, reader `rosbag2`, the commands `ibrobot episodes …` and `contract`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import DecoderDescriptor, ReaderDescriptor, RecorderDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_mcap.changes import (
    Changed,
    DeleteOptions,
    InTrash,
    MarkOptions,
    RepairOptions,
    TrashOptions,
    TrimOptions,
)
from ibrobot_mcap.options import McapOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import CompressedImage, Context, EpisodeAddress, EpisodeReader, Image, Recorder


def _record(options: Any, ctx: Context) -> Recorder:
    from ibrobot_mcap.recorder import McapRecorder

    return McapRecorder(options, ctx)


def _reads(path: Path) -> bool:
    from ibrobot_mcap.reader import is_rosbag2

    return is_rosbag2(path)


def _read(address: EpisodeAddress) -> EpisodeReader:
    from ibrobot_mcap.reader import Rosbag2Reader

    return Rosbag2Reader(address.path)


@hookimpl
def ibrobot_recorders() -> Iterable[RecorderDescriptor]:
    """The recorder of bags."""
    yield RecorderDescriptor(
        type="mcap",
        options=McapOptions,
        make=_record,
        default=True,
        summary="ROS 2 bags: MCAP in a rosbag2 directory",
    )


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """The reader of bags, including foreign ones."""
    yield ReaderDescriptor("rosbag2", "ROS 2 bags: MCAP, also unfinished, and sqlite3", _reads, _read)


def _decoder() -> Callable[[CompressedImage], Image | None]:
    from ibrobot_ros2.pictures import decode_picture

    return decode_picture


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of compressed images in bags."""
    yield DecoderDescriptor(("jpeg", "png", "compressedDepth png"), _decoder)


def _commands() -> click.Command:
    from ibrobot_mcap.commands import episodes

    return episodes


def _contract() -> click.Command:
    from ibrobot_mcap.commands.contract import contract

    return contract


MARK = Command("episodes mark", "Judge episodes.", _commands, MarkOptions, (Changed,))
TRIM = Command("episodes trim", "Keep a part of an episode.", _commands, TrimOptions, (Changed,))
DELETE = Command("episodes delete", "Delete episodes.", _commands, DeleteOptions, (Changed,))
LIST_TRASH = Command(
    "episodes trash", "List, restore or delete what is in a trash.", _commands, TrashOptions, (Changed, InTrash)
)
REPAIR = Command("episodes repair", "Make unfinished episodes whole.", _commands, RepairOptions, (Changed,))
_CHANGES = (MARK, TRIM, DELETE, LIST_TRASH, REPAIR)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot episodes …` and `ibrobot contract init`."""
    summary = "List, check, repair, trim, plot and export recorded episodes."
    yield Command("episodes", summary, _commands, commands=_CHANGES)
    yield Command("contract", "Draft a contract for foreign bags.", _contract)
