"""What the cameras' descriptors say."""

from __future__ import annotations

import ibrobot_camera
import pytest
from ibrobot_camera.options import OpenCvOptions, RealSenseOptions
from ibrobot_testing import check_descriptor


@pytest.mark.parametrize("options", [OpenCvOptions("0"), OpenCvOptions("0", width=64, height=48), RealSenseOptions()])
def test_descriptors_say_what_the_options_say(options: OpenCvOptions | RealSenseOptions) -> None:
    (descriptor,) = (each for each in ibrobot_camera.ibrobot_sensors() if each.options is type(options))
    check_descriptor(descriptor, options)


def test_the_size_of_pictures_is_height_and_width() -> None:
    (descriptor,) = (each for each in ibrobot_camera.ibrobot_sensors() if each.type == "opencv")
    assert descriptor.picture(OpenCvOptions("0", width=64, height=48)) == (48, 64)
