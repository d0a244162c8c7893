"""Compressed pictures in the formats that ROS 2 nodes and cameras send."""

from __future__ import annotations

from ibrobot_core.api import CompressedImage, Image
from ibrobot_ros2.jpeg import from_jpeg, is_jpeg
from ibrobot_ros2.png import from_png, is_png


def is_known(picture: CompressedImage) -> bool:
    """Whether `decode_picture` decodes its format."""
    return is_jpeg(picture) or is_png(picture)


def decode_picture(picture: CompressedImage) -> Image | None:
    """The pixels of a JPEG, a PNG, or the PNG of `compressedDepth`; None for another format.

    Raises:
        ContractError: for a damaged picture.
    """
    if is_jpeg(picture):
        return from_jpeg(picture)
    return from_png(picture) if is_png(picture) else None
