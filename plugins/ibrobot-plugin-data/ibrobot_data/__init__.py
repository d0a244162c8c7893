"""The plugin's hooks: the commands `ibrobot convert`, `ibrobot record`, `ibrobot replay`, and what records episodes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from ibrobot_core.api import Command, NoOptions, SectionDescriptor, hookimpl

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Component, RobotConfig, Session


def _convert() -> click.Command:
    from ibrobot_data.command import convert

    return convert


def _record() -> click.Command:
    from ibrobot_data.record import record

    return record


def _replay() -> click.Command:
    from ibrobot_data.replay import replay

    return replay


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot convert`, `ibrobot record` and `ibrobot replay`."""
    yield Command("convert", "Make a dataset for training from episodes.", _convert)
    yield Command("record", "Run a robot and record its episodes.", _record)
    yield Command("replay", "Play a recorded episode on a robot, and compare.", _replay)


def _recording(options: NoOptions | None, session: Session) -> Component:
    from ibrobot_data.recording_worker import RecordingWorker

    assert session.config.recording is not None
    return RecordingWorker(session, session.config.recording)


def _records(config: RobotConfig) -> bool:
    return config.recording is not None


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """What records the episodes of a run with a section `recording`."""
    yield SectionDescriptor(
        type="episodes", make=_recording, without_section=_records, summary="records the episodes of a run"
    )
