"""Pictures of tags as a camera takes them: by rays through each pixel, several for each."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import cache

import attrs
import numpy as np
from ibrobot_detect.detector import Sight
from ibrobot_detect.tags import _library
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import from_rpy
from numpy.typing import NDArray
from pupil_apriltags.bindings import _ApriltagFamily

FOCAL, WIDTH, HEIGHT = 600.0, 640, 480
RAYS = 3
"""Rays along each side of a pixel."""
_CELLS, _BORDER = 10, 1
"""Cells along the picture of a tag of family tag36h11, and of its white border."""
_GREY = 120.0


@cache
def tag_cells(number: int) -> NDArray[np.uint8]:
    """The cells of a tag, shape (10, 10), by the code that the library knows."""
    library, _ = _library("tag36h11")
    family = ctypes.cast(library.tag_families["tag36h11"], ctypes.POINTER(_ApriltagFamily)).contents
    cells = np.full((_CELLS, _CELLS), 255, np.uint8)
    cells[_BORDER:-_BORDER, _BORDER:-_BORDER] = 0
    for bit in range(family.nbits):
        if family.codes[number] >> (family.nbits - 1 - bit) & 1:
            cells[family.bit_y[bit] + _BORDER, family.bit_x[bit] + _BORDER] = 255
    return cells


def camera(pose: NDArray[np.float64], distortion: NDArray[np.float64] | None = None, name: str = "top") -> Sight:
    """A camera without a picture."""
    intrinsics = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    bent = np.zeros(5) if distortion is None else distortion
    return Sight(name, 1, None, (WIDTH, HEIGHT), intrinsics, bent, pose)


def facing(tilt: float, turn: float, spin: float, place: tuple[float, float, float]) -> NDArray[np.float64]:
    """The pose of a tag in a camera's optical frame: it faces the camera, but for its tilt and turn [rad]."""
    towards = np.diag([1.0, -1.0, -1.0])  # x right, y up, z to the camera
    return homogeneous(from_rpy(0, turn, 0) @ from_rpy(tilt, 0, 0) @ from_rpy(0, 0, spin) @ towards, np.array(place))


def photograph(sight: Sight, tags: Mapping[int, tuple[NDArray[np.float64], float]]) -> Sight:
    """The camera with its picture of tags: number -> pose in the base frame, and size [m]."""
    grey = np.full((HEIGHT, WIDTH), _GREY)
    for number, (placed, size) in tags.items():
        left, top, right, bottom = _window(sight, placed, size)
        shift = (np.arange(RAYS) + 0.5) / RAYS - 0.5
        x = (np.arange(left, right)[:, None] + shift).ravel()
        y = (np.arange(top, bottom)[:, None] + shift).ravel()
        rays = _straight(sight, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)) @ sight.pose[:3, :3].T
        begin, towards = (sight.pose[:3, 3] - placed[:3, 3]) @ placed[:3, :3], rays @ placed[:3, :3]
        far = -begin[2] / towards[:, 2]
        hit = begin[:2] + far[:, None] * towards[:, :2]
        cell = size / (_CELLS - 2 * _BORDER)
        column, row = np.floor(hit[:, 0] / cell + _CELLS / 2), np.floor(_CELLS / 2 - hit[:, 1] / cell)
        on = (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS)
        shades = np.full(len(rays), _GREY)
        shades[on] = tag_cells(number)[row[on].astype(int), column[on].astype(int)]
        grey[top:bottom, left:right] = shades.reshape(bottom - top, RAYS, right - left, RAYS).mean(axis=(1, 3))
    colours = np.repeat((grey + 0.5).astype(np.uint8)[..., None], 3, axis=2)
    return attrs.evolve(sight, pixels=colours)


def _window(sight: Sight, placed: NDArray[np.float64], size: float) -> tuple[int, int, int, int]:
    """The part of the picture with a tag: left, top, right and bottom [px]."""
    half = 0.75 * size
    corners = np.array([[x, y, 0.0] for x in (-half, half) for y in (-half, half)])
    pixels = sight.seen(corners @ placed[:3, :3].T + placed[:3, 3])
    assert pixels is not None
    (left, top), (right, bottom) = np.floor(pixels.min(axis=0)).astype(int), np.ceil(pixels.max(axis=0)).astype(int)
    return max(0, left), max(0, top), min(WIDTH, right), min(HEIGHT, bottom)


def _straight(sight: Sight, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Directions of pixels in the optical frame, shape (N, 3), by solving for what the lens bends there."""
    wanted = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(sight.intrinsics).T
    plain = attrs.evolve(sight, intrinsics=np.eye(3), pose=np.eye(4))
    guess = wanted.copy()
    for _ in range(8):
        seen = plain.seen(guess)
        assert seen is not None
        guess[:, :2] += wanted[:, :2] - seen
    return guess
