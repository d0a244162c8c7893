"""The plugin's hooks: teleop `replay`, recorder `joint_log`, dataset writer `npz`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import DatasetDescriptor, RecorderDescriptor, TeleopDescriptor
from ibrobot_core.hookspecs import hookimpl
from ibrobot_core.options import OptionFault
from ibrobot_jointlog.options import ReplayOptions

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, DatasetWriter, Recorder, Teleop
    from ibrobot_core.robot import Robot


def _replay(options: Any, ctx: Context) -> Teleop:
    from ibrobot_jointlog.replay import ReplayTeleop

    return ReplayTeleop(options, ctx)


def _check_log(options: Any, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
    from ibrobot_core.errors import TeleopError
    from ibrobot_jointlog.log import read_log

    try:
        read_log(options.path, robot.joint_names)
    except TeleopError as error:
        return [OptionFault(("path",), str(error))]
    return ()


def _joint_log(options: Any, ctx: Context) -> Recorder:
    from ibrobot_jointlog.recorder import JointLogRecorder

    return JointLogRecorder(ctx)


def _npz(options: Any, ctx: Context) -> DatasetWriter:
    from ibrobot_jointlog.npz import NpzDatasetWriter

    return NpzDatasetWriter()


@hookimpl
def ibrobot_teleop() -> Iterable[TeleopDescriptor]:
    """What plays a joint log."""
    yield TeleopDescriptor(
        type="replay", options=ReplayOptions, make=_replay, check_options=_check_log,
        summary="plays a recorded joint log (CSV)",
    )  # fmt: skip


@hookimpl
def ibrobot_recorders() -> Iterable[RecorderDescriptor]:
    """What writes a joint log."""
    yield RecorderDescriptor(
        type="joint_log", make=_joint_log, summary="joint positions of an episode as CSV, for replay"
    )


@hookimpl
def ibrobot_datasets() -> Iterable[DatasetDescriptor]:
    """What writes frames as arrays."""
    yield DatasetDescriptor(type="npz", make=_npz, summary="one NumPy .npz file an episode")
