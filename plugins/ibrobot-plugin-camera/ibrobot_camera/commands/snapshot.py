"""`ibrobot camera snapshot`: saves one image of each camera and prints its measured rate."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import attrs
import cv2

from ibrobot_core.api import NS_PER_S, CompressedImage, Image, SensorError, option
from ibrobot_core.app import RequestError, echo, wrong_input

_WAIT_S = 10.0


@attrs.frozen(kw_only=True)
class Snapshot:
    """Save an image of each camera of SOURCE.

    It prints its size, encoding and measured rate.
    """

    source: str = option(typed="SOURCE", help="a device, or a robot YAML")
    output: Path | None = option(None, typed="-o", help="a .png or .jpg file; with several cameras, _NAME is inserted")
    seconds: float = option(1.0, ge=0, help="how long to measure")

    def __call__(self) -> None:
        from ibrobot_camera.commands.sources import opened, pixels

        output = self.output or Path("camera.png")
        if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
            raise RequestError(f"--output: {output}: must end in .png or .jpg")
        with opened(self.source) as cameras, ThreadPoolExecutor(len(cameras)) as pool:
            watched = {name: pool.submit(_watch, name, camera.read, self.seconds) for name, camera in cameras.items()}
            pictures = {name: future.result() for name, future in watched.items()}
        for name, (image, rate_hz) in pictures.items():
            path = output if len(pictures) == 1 else output.with_stem(f"{output.stem}_{name}")
            with wrong_input():
                if not cv2.imwrite(str(path), pixels(image)):
                    raise SensorError(f"{path}: cannot be written")
            echo(f"{path}: {name}, {image.width}x{image.height} {image.encoding}, {rate_hz:.1f} Hz")


def _watch(name: str, read: Callable[[float], Image | CompressedImage | None], seconds: float) -> tuple[Image, float]:
    """The last image within `seconds`, and the rate computed from the stamps [Hz]."""
    from ibrobot_camera.commands.sources import decoded

    first = read(_WAIT_S)
    if first is None:
        raise SensorError(f"camera {name}: no image within {_WAIT_S:.0f} s")
    last, count, end = first, 0, time.monotonic() + seconds
    while (remaining := end - time.monotonic()) > 0:
        image = read(remaining)
        if image is not None:
            last, count = image, count + 1
    span_ns = last.header.stamp_ns - first.header.stamp_ns
    return decoded(last), count * NS_PER_S / span_ns if span_ns else 0.0
