"""The cameras that a command line names: one device, or all of a robot YAML."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import cv2
import numpy as np
from ibrobot_ros2.jpeg import from_jpeg, to_jpeg

from ibrobot_camera.camera import OpenCvCamera, to_image
from ibrobot_camera.capture import Pixels
from ibrobot_camera.options import OpenCvOptions
from ibrobot_core.api import CompressedImage, Context, Image, RealClock, Robot, SensorError
from ibrobot_core.app import RequestError, find_config, installed_plugins, load_config, wrong_input

_UNNAMED = "camera"
_QUALITY = 80
_TO_BGR = {"bgr8": None, "rgb8": cv2.COLOR_RGB2BGR, "mono8": cv2.COLOR_GRAY2BGR}


@contextmanager
def opened(source: str, one: str | None = None) -> Iterator[dict[str, OpenCvCamera]]:
    """Open the cameras of a device or a robot YAML; yields name -> camera.

    Args:
        source: a device or the path of a robot YAML.
        one: the name of the only camera to open; empty for the only camera; None to open all.

    Raises:
        ConfigError: if the robot YAML has mistakes.
        RequestError: if the robot YAML has no camera `one`, or several and `one` is empty.
        SensorError: if a camera does not open, or the YAML has none.
    """
    clock = RealClock()
    with ExitStack() as stack:
        cameras = {}
        by_name = _options(source)
        for name, options in (by_name if one is None else _only(source, by_name, one)).items():
            ctx = Context(name, clock, logging.getLogger(f"ibrobot.{name}"), Robot("camera", ()))
            camera = OpenCvCamera(options, ctx)
            with wrong_input():
                _open(camera)
            stack.callback(camera.close)
            cameras[name] = camera
        yield cameras


def _open(camera: OpenCvCamera) -> None:
    try:
        camera.open()
    except SensorError as error:
        # A device given directly has no name in a YAML; the rest of the message begins with the device.
        raise SensorError(str(error).removeprefix(f"camera {_UNNAMED}: ")) from None


def _options(source: str) -> dict[str, OpenCvOptions]:
    registry = installed_plugins()
    if not source.endswith((".yaml", ".yml")):
        return {_UNNAMED: OpenCvOptions(device=source, strict=False)}
    config = load_config(find_config(source, registry), registry=registry)
    by_name = {name: p.options for name, p in config.peripherals.items() if isinstance(p.options, OpenCvOptions)}
    if not by_name:
        raise SensorError(f"{source}: has no camera of type opencv")
    return by_name


def _only(source: str, by_name: dict[str, OpenCvOptions], name: str) -> dict[str, OpenCvOptions]:
    known = ", ".join(by_name)
    if name and name not in by_name:
        raise RequestError(f"--camera: {source} has no opencv camera {name!r}; it has: {known}")
    if not name and len(by_name) > 1:
        raise RequestError(f"{source} has several cameras ({known}): name one with --camera")
    return {name: by_name[name]} if name else by_name


def decoded(message: Image | CompressedImage) -> Image:
    """A camera's message, decoded to pixels."""
    return from_jpeg(message) if isinstance(message, CompressedImage) else message


def browser_jpeg(image: Image | CompressedImage) -> bytes:
    """A camera's message as browsers show it; depth is shown in colours, up to 4 m."""
    if isinstance(image, Image) and image.encoding == "16UC1":
        coloured = cv2.applyColorMap(cv2.convertScaleAbs(pixels(image), alpha=255 / 4000), cv2.COLORMAP_TURBO)
        image = to_image(np.asarray(coloured, dtype=np.uint8), image.header)
    return (to_jpeg(image, _QUALITY) if isinstance(image, Image) else image).data.tobytes()


def pixels(image: Image) -> Pixels:
    """An image in OpenCV's layout: (H, W, 3) BGR, or (H, W) for depth."""
    if image.encoding == "16UC1":
        return image.data.view(np.uint16).reshape(image.height, image.width)
    conversion = _TO_BGR[image.encoding]
    shape = (image.height, image.width) if image.encoding == "mono8" else (image.height, image.width, 3)
    array = image.data.reshape(shape)
    return array if conversion is None else np.asarray(cv2.cvtColor(array, conversion), dtype=np.uint8)
