"""The plugin's hooks: sensors `opencv` and `realsense`, the commands `ibrobot camera …`, a check of the cameras."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_terminal import GuideDescriptor

from ibrobot_camera.options import OpenCvOptions, RealSenseOptions
from ibrobot_core.api import Check, DecoderDescriptor, Late, SensorDescriptor, hookimpl
from ibrobot_core.app import Command


@hookimpl
def ibrobot_sensors() -> Iterable[SensorDescriptor]:
    """Cameras."""
    yield SensorDescriptor(
        type="opencv",
        options=OpenCvOptions,
        make=Late("ibrobot_camera.camera:OpenCvCamera"),
        summary="V4L2 device, RTSP or HTTP stream, or video file",
    )
    yield SensorDescriptor(
        type="realsense",
        options=RealSenseOptions,
        make=Late("ibrobot_camera.realsense:RealSenseCamera"),
        check=Late("ibrobot_camera.librealsense:load_library"),
        summary="Intel RealSense: colour, or aligned depth",
    )


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of JPEG images, and what removes the distortion of a lens from images."""
    yield DecoderDescriptor(
        ("jpeg", "png", "compressedDepth png"),
        Late("ibrobot_ros2.pictures:decode_picture").load,
        Late("ibrobot_camera.rectify:Rectifier.of"),
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot camera …`."""
    yield Command(
        "camera",
        summary="List and preview cameras, and save snapshots.",
        about="SOURCE is a device as in a robot YAML (a number, a path, a stable id, a URL, a video file), or a robot "
        "YAML, which means all its `opencv` cameras.",
    )
    yield Command("camera list", Late("ibrobot_camera.commands.list_cameras:ListCameras"))
    yield Command("camera preview", Late("ibrobot_camera.commands.preview:Preview"))
    yield Command("camera snapshot", Late("ibrobot_camera.commands.snapshot:Snapshot"))
    yield Command("camera board", Late("ibrobot_camera.commands.calibrate:MakeBoard"))
    yield Command("camera calibrate", Late("ibrobot_camera.commands.calibrate:CalibrateCamera"))
    yield Command("camera mount", Late("ibrobot_camera.commands.mount:MountCamera"))


@hookimpl(optionalhook=True)
def ibrobot_guides() -> Iterable[GuideDescriptor]:
    """The cameras, with pictures."""
    summary = "List the cameras, with their formats and a picture of each."
    yield GuideDescriptor(
        "cameras",
        order=60,
        label="Cameras",
        summary=summary,
        make=Late("ibrobot_camera.guides:show_cameras"),
        questions=Late("ibrobot_camera.guides:camera_questions"),
    )
    yield GuideDescriptor(
        "board",
        order=65,
        label="Make a board to print",
        summary="A page with the board for the calibration of cameras, at true size.",
        make=Late("ibrobot_camera.commands.calibrate:make_board"),
        questions=Late("ibrobot_camera.commands.calibrate:board_questions"),
    )
    yield GuideDescriptor(
        "lens",
        order=70,
        label="Calibrate a camera",
        summary="Measure the lens of a camera with a printed board; “Make a board to print” makes its page.",
        make=Late("ibrobot_camera.commands.calibrate:guided"),
        questions=Late("ibrobot_camera.commands.calibrate:questions"),
    )
    yield GuideDescriptor(
        "mount",
        order=75,
        label="Measure where a camera is mounted",
        summary="From a recording in which the camera sees the board of its calibration while the arm turns.",
        make=Late("ibrobot_camera.commands.mount:guided"),
        questions=Late("ibrobot_camera.commands.mount:questions"),
    )


@hookimpl
def ibrobot_doctor() -> Iterable[Check]:
    """Check which cameras the user may open."""
    from ibrobot_camera.v4l2 import cameras

    for camera in cameras():
        state = camera.problem or camera.name
        yield Check(f"camera {camera.path}", not camera.problem, state, "sudo usermod -aG video $USER, log in again")
