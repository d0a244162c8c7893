"""A made-up arm with a camera and a board: sessions whose mount is known."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import attrs
import cv2
import numpy as np
from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.intrinsics.views import View
from ibrobot_camera.mounting.fit import Session
from ibrobot_camera.mounting.shots import Lens, Shot, shot_of
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import exp, from_rpy
from ibrobot_kinematics.urdf import read_urdf

from ibrobot_core.api import Vector

SIZE = 640, 480
LENS = Lens(SIZE, np.array([[560.0, 0, 322.0], [0, 558.0, 238.0], [0, 0, 1]]), np.array([-0.2, 0.05, 0.001, 0.0, 0.0]))
BOARD = Board()
JOINTS = ("pan", "lift", "elbow", "flex", "roll", "gripper")
USUAL = np.array([0.1, -0.4, 0.7, 0.5, 0.1, 0.3])
_PARTS = (
    ("pan", "base", "turret", "0 0 0.06", "0 0 1"),
    ("lift", "turret", "upper", "0.03 0 0.05", "0 1 0"),
    ("elbow", "upper", "lower", "0.03 0 0.11", "0 1 0"),
    ("flex", "lower", "wrist", "0.13 0 0", "0 1 0"),
    ("roll", "wrist", "hand", "0.06 0 0", "1 0 0"),
    ("gripper", "hand", "jaw", "0.03 0.02 0", "0 0 1"),
)
"""Joint, parent, child, place of the child [m] and axis."""


def urdf(folder: Path) -> Path:
    """The file of the arm."""
    names = ["base", *(child for _, _, child, _, _ in _PARTS), "stand"]
    joints = "".join(
        f'<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-3" upper="3" effort="1" velocity="3"/></joint>'
        for name, parent, child, xyz, axis in _PARTS
    )
    fixed = (
        '<joint name="bolt" type="fixed"><parent link="base"/><child link="stand"/><origin xyz="0.5 0.3 0.4"/></joint>'
    )
    path = folder / "arm.urdf"
    path.write_text(
        f'<robot name="arm">{"".join(f"<link name={chr(34)}{n}{chr(34)}/>" for n in names)}{joints}{fixed}</robot>'
    )
    return path


@attrs.frozen(eq=False)
class Truth:
    """A session, and what its mount is."""

    session: Session
    camera: Vector
    board: Vector
    wrong: tuple[str, ...]
    """The pictures that are outliers."""


def made(
    folder: Path, seed: int = 1, *, count: int = 20, noise: float = 1.0, outliers: float = 0.0, in_hand: bool = True,
    spread: Vector | float = 0.35, swapped: tuple[int, int] | None = None, reversed_: int | None = None,
    square: float = 1.0, shaken: float = 0.0, moves_at: int | None = None, measured: bool = False,
    size: tuple[int, int] = SIZE,
) -> Truth:  # fmt: skip
    """A session.

    Args:
        folder: for the arm's file.
        seed: of everything random.
        count: number of pictures.
        noise: of the corners [px].
        outliers: share of the pictures whose readings are wrong.
        in_hand: whether the camera is in the hand and the board beside the arm, or the other way round.
        spread: deviation of the joints [rad].
        swapped: joints whose readings are exchanged.
        reversed_: joint whose reading has the other sign.
        square: size of the printed squares, as a share of the stated one.
        shaken: deviation of all readings from the truth [rad].
        moves_at: picture from which on the board stands elsewhere.
        measured: whether the place of the board is known.
        size: of the pictures.
    """
    rng = np.random.default_rng(seed)
    links = ("hand", "base") if in_hand else ("stand", "hand")
    chain = Chain(read_urdf(urdf(folder)), JOINTS, *links)
    usual = chain.pose(USUAL)
    if in_hand:
        camera = homogeneous(
            from_rpy(-1.5, 0.1, -1.6) @ exp(rng.normal(0, 0.1, 3)), rng.normal((0.03, 0.0, 0.06), 0.01)
        )
        board = np.linalg.inv(usual) @ camera @ _ahead(rng)
    else:
        board = homogeneous(exp(rng.normal(0, 0.3, 3)), np.array([0.08, -0.1, -0.05]))
        camera = usual @ board @ np.linalg.inv(_ahead(rng))
    points = np.asarray(BOARD.pattern.getChessboardCorners(), np.float32).reshape(-1, 3)
    shots: list[Shot] = []
    wrong: list[str] = []
    bad = set(rng.permutation(count)[: round(outliers * count)].tolist())
    elsewhere = board @ homogeneous(exp(np.array([0.05, 0.02, 0.1])), np.array([0.03, -0.02, 0.0]))
    while len(shots) < count:
        number = len(shots)
        joints = USUAL + rng.normal(0, 1, 6) * spread
        placed = elsewhere if moves_at is not None and number >= moves_at else board
        pose = np.linalg.inv(camera) @ chain.pose(joints) @ placed
        pixels = LENS.pixels(points.astype(np.float64) * square, pose)
        inside = ((pixels > 4) & (pixels < np.array(SIZE) - 4)).all(axis=1)
        if pose[2, 2] < 0.35 or inside.sum() < 30:  # seen from the side, or not
            continue
        if number in bad:
            joints = joints + rng.choice([-1, 1], 6) * rng.uniform(0.1, 0.5, 6)
            wrong.append(f"picture {number}")
        joints = joints + rng.normal(0, 1, 6) * shaken
        if swapped is not None:
            joints[list(swapped)] = joints[list(swapped[::-1])]
        if reversed_ is not None:
            joints[reversed_] *= -1
        corners = (pixels + rng.normal(0, noise, pixels.shape)).astype(np.float32)
        view = View(
            f"picture {number}",
            size,
            np.flatnonzero(inside).astype(np.int32),
            corners[inside],
            points[inside],
            np.zeros(5),
        )
        if (shot := shot_of(view, joints, LENS)) is not None:
            shots.append(shot)
    return Truth(Session(shots, chain, LENS, board if measured else None), camera, board, tuple(wrong))


def _ahead(rng: np.random.Generator) -> Vector:
    """A board before the camera."""
    turned = exp(rng.normal(0, 0.25, 3))
    middle = np.array([BOARD.columns, BOARD.rows, 0.0]) * BOARD.square / 2000
    return homogeneous(turned, np.array([0.0, 0.0, 0.42]) - turned @ middle)


def off(place: Vector, truth: Vector) -> tuple[float, float]:
    """Distance [mm] and angle [deg] of two poses."""
    turned = np.linalg.norm(cv2.Rodrigues(place[:3, :3] @ truth[:3, :3].T)[0])
    return 1000 * float(np.linalg.norm(place[:3, 3] - truth[:3, 3])), float(np.degrees(turned))


OPTICAL: Mapping[str, Vector] = {"in its mount": np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])}
"""The camera's optical frame (z ahead, x right, y down) in that of its mount (x ahead, y left, z up)."""
