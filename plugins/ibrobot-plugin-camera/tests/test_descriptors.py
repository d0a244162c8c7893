"""What the cameras' descriptors say."""

from __future__ import annotations

from pathlib import Path

import ibrobot_camera
import pytest
from ibrobot_camera.options import OpenCvOptions, RealSenseOptions
from ibrobot_testing import check_descriptor, host_context


@pytest.mark.parametrize("options", [OpenCvOptions("0"), OpenCvOptions("0", width=64, height=48), RealSenseOptions()])
def test_descriptors_say_what_the_options_say(options: OpenCvOptions | RealSenseOptions) -> None:
    (descriptor,) = (each for each in ibrobot_camera.ibrobot_sensors() if each.options is type(options))
    check_descriptor(descriptor, options)


def test_the_size_of_pictures_is_height_and_width() -> None:
    assert OpenCvOptions("0", width=64, height=48).picture == (48, 64)


def test_only_a_v4l2_device_is_one_that_two_may_not_open(tmp_path: Path) -> None:
    video = tmp_path / "pick.mp4"
    video.touch()
    used = [OpenCvOptions(source).devices() for source in (7, "/dev/video7", str(video), "rtsp://a/b", "none")]
    assert used == [{"device": "/dev/video7"}] * 2 + [{}] * 3


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (None, "cannot be read"),
        ("- 1", "must be a mapping, as camera_calibration writes it"),
        ("{image_width: 640, image_height: tall}", "image_width and image_height must be whole numbers"),
        ("a: [", "cannot be read"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_found_before_a_run(tmp_path: Path, text: str | None, wrong: str) -> None:
    if text is not None:
        (tmp_path / "top.yaml").write_text(text)
    options = OpenCvOptions("0", info=tmp_path / "top.yaml")
    robot = host_context().robot
    (fault,) = options.check(robot, robot.joint_names)
    assert fault.option == ("info",)
    assert fault.message.startswith(f"{tmp_path}/top.yaml: ")
    assert wrong in fault.message
