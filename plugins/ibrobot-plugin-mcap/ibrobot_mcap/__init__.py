"""The plugin's hooks: recorder `mcap`, reader `rosbag2`, the commands `ibrobot episodes …` and `contract`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import DecoderDescriptor, Late, ReaderDescriptor, RecorderDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_mcap.changes import Changed, InTrash
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


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot episodes …` and `ibrobot contract init`."""
    yield Command(
        "episodes",
        summary="List, check, repair, trim, plot and export recorded episodes.",
        about="An episode is a folder such as episodes/pick_cube/episodes/episode_000001. Commands that take several "
        "episodes also accept a dataset, or the folder of all datasets.",
    )
    yield Command("episodes list", Late("ibrobot_mcap.commands.list_episodes:ListEpisodes"))
    yield Command("episodes info", Late("ibrobot_mcap.commands.list_episodes:ShowEpisode"))
    yield Command("episodes answers", Late("ibrobot_mcap.commands.answers:ShowAnswers"))
    yield Command("episodes verify", Late("ibrobot_mcap.commands.verify:Verify"))
    yield Command("episodes plot", Late("ibrobot_mcap.commands.plot:Plot"))
    yield Command("episodes export", Late("ibrobot_mcap.commands.export:Export"))
    change = "ibrobot_mcap.commands.change"
    yield Command("episodes mark", Late(f"{change}:Mark"), "Judge episodes.", (Changed,))
    yield Command("episodes trim", Late(f"{change}:Trim"), "Keep a part of an episode.", (Changed,))
    yield Command("episodes delete", Late(f"{change}:Delete"), "Delete episodes.", (Changed,))
    summary = "List, restore or delete what is in a trash."
    yield Command("episodes trash", Late(f"{change}:ListTrash"), summary, (Changed, InTrash))
    yield Command("episodes repair", Late(f"{change}:Repair"), "Make unfinished episodes whole.", (Changed,))
    yield Command("contract", summary="Draft a contract for foreign bags.")
    yield Command("contract init", Late("ibrobot_mcap.commands.contract:DraftContract"))
