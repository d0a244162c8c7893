"""The plugin's hooks: `ibrobot convert`, `ibrobot record`, `ibrobot replay`, corrections and recording."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Check, Late, hookimpl
from ibrobot_core.app import Command, SectionDescriptor, SourceDescriptor
from ibrobot_data.conversion import EVENTS
from ibrobot_data.options import EpisodesOptions, check_keys
from ibrobot_data.recording_session import Session as SessionEvent

if TYPE_CHECKING:
    from ibrobot_core.app import Component, RecordedRun, RobotConfig

_LEAST_FREE_BYTES = 2_000_000_000


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot convert`, `ibrobot record` and `ibrobot replay`."""
    summary = "Make a dataset for training from episodes."
    yield Command("convert", Late("ibrobot_data.command:Convert"), summary, EVENTS)
    summary = "Run a robot and record its episodes."
    yield Command("record", Late("ibrobot_data.record:Record"), summary, (SessionEvent, *EVENTS))
    yield Command("replay", Late("ibrobot_data.replay:Replay"), "Play a recorded episode on a robot, and compare.")


@hookimpl
def ibrobot_sources() -> Iterable[SourceDescriptor]:
    """The command source of modes with `inference: {intervene: …}`."""
    yield SourceDescriptor(
        type="intervene",
        make=Late("ibrobot_data.corrections:Corrections"),
        summary="lets an operator take the robot from a policy, and give it back",
    )


def _recording(options: EpisodesOptions | None, session: RecordedRun) -> Component:
    from ibrobot_data.episode_service import EpisodeService
    from ibrobot_data.partial_recording import PartialRecording
    from ibrobot_data.recording_worker import NoRecording, RecordingWorker

    if session.config.recording is None:
        return NoRecording("recording", "of nothing")
    if options is None or options.keep == "all":
        worker = RecordingWorker(session)
    else:
        worker = PartialRecording(session, options)
    EpisodeService(session, worker)
    return worker


def _records(config: RobotConfig) -> bool:
    return config.recording is not None


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check the disk space for recordings."""
    free = shutil.disk_usage(".").free
    remedy = f"free at least {_LEAST_FREE_BYTES / 1e9:.0f} GB, or record elsewhere with recording.root"
    yield Check("disk", free >= _LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free in {os.path.abspath('.')}", remedy)


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """The section `episodes`, whose component records the episodes of a run."""
    yield SectionDescriptor(
        type="episodes",
        options=EpisodesOptions,
        make=_recording,
        without_section=_records,
        records_episodes=True,
        check_config=check_keys,
        summary="how an operator corrects a policy, and which parts of a run are kept",
    )
