"""Removes the distortion of a lens from images, as `rectify` in the contract asks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import CameraInfo, ContractError

_COEFFICIENTS: Mapping[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8), "equidistant": (0, 4),
}  # fmt: skip
"""Distortion models of ROS -> numbers of coefficients that they may have."""
_MATRICES: Mapping[str, tuple[int, int]] = {"k": (3, 3), "r": (3, 3), "p": (3, 4)}
_LARGEST_PX = 8192
_PARTS = 32
"""Steps into which OpenCV's maps divide the distance of two pixels."""


@attrs.frozen(eq=False, slots=False)
class Rectifier:
    """Maps images of a camera to those of the pinhole camera `p` of its calibration, as ROS's image_proc does.

    Colours are interpolated between four pixels. Depth is taken from the nearest pixel, since a mean over an edge would
    be a surface that does not exist. What the camera did not see is 0.

    OpenCV does both with whole numbers, so the bits depend neither on the machine nor on its version.
    """

    width: int
    height: int
    model: str
    d: NDArray[np.float64]
    """Coefficients of the distortion, in OpenCV's order."""
    k: NDArray[np.float64]
    """Camera matrix [px], shape (3, 3)."""
    r: NDArray[np.float64]
    """Rotation to the pinhole camera, shape (3, 3)."""
    p: NDArray[np.float64]
    """Its projection [px], shape (3, 3)."""

    @classmethod
    def of(cls, lens: Mapping[str, Any]) -> Rectifier:
        """The rectifier for the intrinsics in a contract, which may come from an untrusted recording.

        Raises:
            ContractError: if they are not those of a camera.
        """
        if not isinstance(lens, Mapping):
            raise ContractError(f"rectify: needs the intrinsics of the camera, not {lens!r}")
        width, height = (_size(lens, name) for name in ("width", "height"))
        model = lens.get("distortion_model")
        if not isinstance(model, str) or model not in _COEFFICIENTS:
            raise ContractError(f"rectify: distortion_model: {model!r} is none of {', '.join(_COEFFICIENTS)}")
        d = _numbers(lens, "d")
        if d.size not in _COEFFICIENTS[model]:
            counts = " or ".join(map(str, _COEFFICIENTS[model]))
            raise ContractError(f"rectify: d: {model} has {counts} coefficients, not {d.size}")
        k, r, p = (_matrix(lens, name) for name in _MATRICES)
        return cls(width, height, model, d, k, r, p)

    def __call__(self, image: NDArray[Any]) -> NDArray[Any]:
        """The image without distortion; of the same shape (H, W, C) and type.

        Raises:
            ContractError: for an image of another size than that of the calibration.
        """
        height, width, channels = image.shape
        if (width, height) != (self.width, self.height):
            raise ContractError(
                f"rectify: the calibration is for images of {self.width}x{self.height}, this one has {width}x{height}"
            )
        if self._changes_nothing:
            return image
        import cv2

        if image.dtype == np.uint8:
            result = cv2.remap(np.ascontiguousarray(image), *self._maps, cv2.INTER_LINEAR)
        else:
            result = cv2.remap(np.ascontiguousarray(image), self._nearest, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
        return np.asarray(result, image.dtype).reshape(height, width, channels)

    @property
    def _changes_nothing(self) -> bool:
        return not self.d.any() and np.array_equal(self.k, self.p) and np.array_equal(self.r, np.eye(3))

    @cached_property
    def _maps(self) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
        """Source of each pixel: whole pixels, shape (H, W, 2), and the index of the fraction, shape (H, W)."""
        import cv2

        make = cv2.fisheye.initUndistortRectifyMap if self.model == "equidistant" else cv2.initUndistortRectifyMap
        d = self.d if self.d.size else np.zeros(4)
        whole, parts = make(self.k, d, self.r, self.p, (self.width, self.height), cv2.CV_16SC2)
        return np.asarray(whole, np.int16), np.asarray(parts, np.uint16)

    @cached_property
    def _nearest(self) -> NDArray[np.int16]:
        """The nearest source of each pixel, shape (H, W, 2): of the maps, OpenCV takes the pixel to the upper left."""
        whole, parts = self._maps
        return whole + (np.stack([parts % _PARTS, parts // _PARTS], axis=2) >= _PARTS // 2).astype(np.int16)


def facts_of(info: CameraInfo) -> dict[str, Any]:
    """The intrinsics in the form of a contract."""
    matrices = {name: getattr(info, name).tolist() for name in ("d", *_MATRICES)}
    return {"width": info.width, "height": info.height, "distortion_model": info.distortion_model, **matrices}


def _size(lens: Mapping[str, Any], name: str) -> int:
    size = lens.get(name)
    if not isinstance(size, int) or isinstance(size, bool) or not 2 <= size <= _LARGEST_PX:
        raise ContractError(f"rectify: {name}: must be a whole number from 2 to {_LARGEST_PX}, not {size!r}")
    return size


def _matrix(lens: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Shape (3, 3): of a projection, without its last column."""
    numbers, (rows, columns) = _numbers(lens, name), _MATRICES[name]
    if numbers.size != rows * columns:
        raise ContractError(f"rectify: {name}: must have {rows * columns} numbers, not {numbers.size}")
    matrix = numbers.reshape(rows, columns)[:, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        volume = abs(np.linalg.det(matrix))
    if not 1e-9 <= volume < np.inf or not np.diag(matrix).all():
        raise ContractError(f"rectify: {name}: {numbers.tolist()} is not the matrix of a camera")
    return matrix


def _numbers(lens: Mapping[str, Any], name: str) -> NDArray[np.float64]:
    """Shape (N,)."""
    given = lens.get(name)
    try:
        numbers = np.array(given, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise ContractError(f"rectify: {name}: must be a list of finite numbers, not {given!r}")
    return numbers
