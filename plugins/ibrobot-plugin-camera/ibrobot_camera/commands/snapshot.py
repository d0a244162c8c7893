"""`ibrobot camera snapshot`: saves one image of each camera and prints its measured rate."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import cv2

from ibrobot_core.api import NS_PER_S, CompressedImage, Image, SensorError
from ibrobot_core.app import echo, wrong_input

_WAIT_S = 10.0


@click.command()
@click.argument("source")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    help="A .png or .jpg file; with several cameras, _NAME is inserted.",
)
@click.option("--seconds", type=click.FloatRange(min=0), default=1.0, show_default=True, help="How long to measure.")
def snapshot(source: str, output: Path | None, seconds: float) -> None:
    """Save an image of each camera of SOURCE.

    It prints its size, encoding and measured rate.
    """
    from ibrobot_camera.commands.sources import opened, pixels

    output = output or Path("camera.png")
    if output.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise click.BadParameter(f"{output}: must end in .png or .jpg", param_hint="--output")
    with opened(source) as cameras, ThreadPoolExecutor(len(cameras)) as pool:
        watched = {name: pool.submit(_watch, name, camera.read, seconds) for name, camera in cameras.items()}
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
