"""The plugin's hooks: recorder `mcap`, reader `rosbag2`, the commands `ibrobot episodes …` and `contract`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import DecoderDescriptor, Late, ReaderDescriptor, RecorderDescriptor, hookimpl
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


@hookimpl
def ibrobot_recorders() -> Iterable[RecorderDescriptor]:
    """The recorder of bags."""
    yield RecorderDescriptor(
        type="mcap",
        options=McapOptions,
        make=Late("ibrobot_mcap.recorder:McapRecorder"),
        default=True,
        summary="ROS 2 bags: MCAP in a rosbag2 directory",
    )


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """The reader of bags, including foreign ones."""
    yield ReaderDescriptor(
        "rosbag2",
        "ROS 2 bags: MCAP, also unfinished, and sqlite3",
        Late("ibrobot_mcap.reader:is_rosbag2"),
        lambda address: Late("ibrobot_mcap.reader:Rosbag2Reader")(address.path),
    )


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of compressed images in bags."""
    yield DecoderDescriptor(("jpeg", "png", "compressedDepth png"), Late("ibrobot_ros2.pictures:decode_picture").load)


_EPISODES = Late("ibrobot_mcap.commands:episodes").load
MARK = Command("episodes mark", "Judge episodes.", _EPISODES, MarkOptions, (Changed,))
TRIM = Command("episodes trim", "Keep a part of an episode.", _EPISODES, TrimOptions, (Changed,))
DELETE = Command("episodes delete", "Delete episodes.", _EPISODES, DeleteOptions, (Changed,))
LIST_TRASH = Command(
    "episodes trash", "List, restore or delete what is in a trash.", _EPISODES, TrashOptions, (Changed, InTrash)
)
REPAIR = Command("episodes repair", "Make unfinished episodes whole.", _EPISODES, RepairOptions, (Changed,))
_CHANGES = (MARK, TRIM, DELETE, LIST_TRASH, REPAIR)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot episodes …` and `ibrobot contract init`."""
    summary = "List, check, repair, trim, plot and export recorded episodes."
    yield Command("episodes", summary, _EPISODES, commands=_CHANGES)
    yield Command(
        "contract", "Draft a contract for foreign bags.", Late("ibrobot_mcap.commands.contract:contract").load
    )
