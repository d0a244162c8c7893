"""The plugin's hooks: recorder and reader `joint_log`, dataset writer `npz`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import DatasetDescriptor, Late, ReaderDescriptor, RecorderDescriptor, hookimpl

if TYPE_CHECKING:
    from ibrobot_core.api import Context, DatasetWriter, Recorder


def _joint_log(options: Any, ctx: Context) -> Recorder:
    from ibrobot_jointlog.recorder import JointLogRecorder

    return JointLogRecorder(ctx)


def _npz(options: Any, ctx: Context) -> DatasetWriter:
    from ibrobot_jointlog.npz import NpzDatasetWriter

    return NpzDatasetWriter()


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
        type="joint_log", make=_joint_log, summary="joint positions of an episode as CSV, for replay"
    )


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """The writer of NumPy datasets."""
    yield DatasetDescriptor(type="npz", make=_npz, summary="one NumPy .npz file per episode")
