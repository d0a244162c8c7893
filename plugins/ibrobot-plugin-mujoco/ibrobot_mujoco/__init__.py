"""The SO-101 in MuJoCo: hardware, cameras, scenes with scripted experts, and a viewer for ibrobot."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ibrobot_provenance.reports import ReportDescriptor

from ibrobot_core.api import (
    DecoderDescriptor,
    Descriptor,
    HardwareDescriptor,
    Late,
    PolicyDescriptor,
    SensorDescriptor,
    ViewerDescriptor,
    hookimpl,
)
from ibrobot_core.app import Command, Kind
from ibrobot_mujoco.experts import EXPERTS
from ibrobot_mujoco.gl import choose, from_module
from ibrobot_mujoco.identification.options import EVENTS, KIND, REPORT
from ibrobot_mujoco.options import CameraOptions, MujocoOptions
from ibrobot_mujoco.scene import SceneDescriptor
from ibrobot_mujoco.scenes import SCENES


def _can_render() -> None:
    choose()


@hookimpl
def ibrobot_hardware() -> Iterable[HardwareDescriptor]:
    """Physics."""
    yield HardwareDescriptor(
        type="mujoco",
        options=MujocoOptions,
        make=from_module("hardware", "MujocoHardware"),
        default=True,
        simulated=True,
        sensors={"camera": "mujoco"},
        film={"type": "mujoco", "camera": "front", "width": 320, "height": 240, "fps": 10},
        summary="the robot's MJCF in MuJoCo, with the objects of a scene",
    )


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Scenes."""
    yield Kind("scene", "ibrobot_scenes", SceneDescriptor)


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    yield Descriptor("scene", Late("ibrobot_mujoco.mujoco_scene_suite:FakeTableScene"), "a cube on a table")


@hookimpl
def ibrobot_scenes() -> Iterable[SceneDescriptor]:
    """Objects around the robot, and tasks."""
    yield from SCENES.values()


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Cameras in the simulated scene."""
    yield SensorDescriptor(
        type="mujoco",
        kind="camera",
        options=CameraOptions,
        make=from_module("camera", "MujocoCamera"),
        check=_can_render,
        summary="a camera in the simulated scene",
    )


@hookimpl(optionalhook=True)
def ibrobot_arm_views() -> Iterable[Descriptor[Any]]:
    """What draws the arm in a camera."""
    yield Descriptor("mujoco", from_module("arm_view", "ArmView"), "the arm's MJCF, drawn in a camera by MuJoCo")


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot config new` and `ibrobot identify`."""
    identify = Late("ibrobot_mujoco.identification.command:Identify")
    yield Command("identify", identify, "Find the parameters of a simulated arm from recordings.", EVENTS)
    summary = "Write a robot YAML for the arm in a URDF or MJCF."
    yield Command("config new", Late("ibrobot_mujoco.new_robot:NewRobot"), summary)


def _is_identification(folder: Path) -> bool:
    return (folder / REPORT).is_file()


@hookimpl(optionalhook=True)
def ibrobot_reports() -> Iterable[ReportDescriptor]:
    """Identifications of arms."""
    contents = "ibrobot_mujoco.identification.contents"
    yield ReportDescriptor(
        KIND,
        summary="How a simulated arm was made to move as a real one.",
        label="Identifications",
        command="identify",
        reads=_is_identification,
        lines=Late(f"{contents}:lines_of"),
        make=Late(f"{contents}:read_contents"),
    )


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """Scripted experts."""
    yield from EXPERTS


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of images from simulated cameras."""
    yield DecoderDescriptor(("jpeg", "png", "compressedDepth png"), Late("ibrobot_ros2.pictures:decode_picture").load)


@hookimpl
def ibrobot_viewers() -> Iterable[ViewerDescriptor]:
    """A window on a desktop."""
    yield ViewerDescriptor(
        type="mujoco",
        make=from_module("viewer", "MujocoViewer"),
        default=True,
        flag="--window",
        summary="a desktop window on the simulated scene",
    )
