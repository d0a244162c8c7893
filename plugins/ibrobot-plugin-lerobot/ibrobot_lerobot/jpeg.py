"""JPEG for images that are sent to a model on another machine."""

from __future__ import annotations

from typing import override

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ibrobot_core.api import PictureCodec
from ibrobot_core.app import WireError

_SPACES = {3: "RGB", 1: "GRAY"}


class Jpeg(PictureCodec):
    """Encodes images as JPEG, with colour at half the resolution.

    Args:
        quality: 1 to 100.
    """

    def __init__(self, quality: int) -> None:
        self._quality = quality

    @override
    def encode(self, name: str, picture: NDArray[np.uint8]) -> bytes | None:
        space = _SPACES[picture.shape[2]]
        colours = "420" if space == "RGB" else "Gray"
        jpeg: bytes = simplejpeg.encode_jpeg(np.ascontiguousarray(picture), self._quality, space, colours)
        return jpeg

    @override
    def decode(self, jpeg: memoryview, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(jpeg)
            if (height, width) != shape[:2]:
                raise WireError(f"JPEG of {height}x{width} pixels where {shape[0]}x{shape[1]} were announced")
            pixels: NDArray[np.uint8] = simplejpeg.decode_jpeg(jpeg, _SPACES[shape[2]])
        except ValueError as error:
            raise WireError(f"a damaged JPEG: {error}") from error
        return pixels
