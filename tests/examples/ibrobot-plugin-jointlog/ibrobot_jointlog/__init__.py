"""The plugin's hooks: recorder and reader `joint_log`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, ReaderDescriptor, RecorderDescriptor, hookimpl


@hookimpl
def ibrobot_readers() -> Iterable[ReaderDescriptor]:
    """The reader of joint logs."""
    yield ReaderDescriptor(
        "joint_log",
        "joint logs: CSV",
        Late("ibrobot_jointlog.reader:is_joint_log"),
        Late("ibrobot_jointlog.reader:JointLogReader"),
    )


@hookimpl
def ibrobot_recorders() -> Iterable[RecorderDescriptor]:
    """The recorder of joint logs."""
    yield RecorderDescriptor(
        type="joint_log",
        make=lambda options, ctx: Late("ibrobot_jointlog.recorder:JointLogRecorder")(ctx),
        summary="joint positions of an episode as CSV, for replay",
    )
