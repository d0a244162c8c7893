"""`ibrobot camera board` and `calibrate`: pictures of a board through known lenses give these lenses back."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import attrs
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_camera.calibration import load_info
from ibrobot_camera.commands import calibrate
from ibrobot_camera.intrinsics.board import PAPERS, Board
from ibrobot_camera.intrinsics.solve import solve
from ibrobot_camera.intrinsics.views import View, Views, find
from ibrobot_testing.command import command_line
from PIL import Image

from ibrobot_core.api import Header, SensorError

from .lens_rays import directions

SIZE = 640, 480
LENS = np.array([[560.0, 0.0, 327.0], [0.0, 555.0, 236.0], [0.0, 0.0, 1.0]])
BARREL = np.array([-0.25, 0.08, 0.001, -0.0005, 0.0])
BOARD = Board()
camera = command_line("camera")

POSES = [
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.30), (0.5, 0.0, 0.0, 0.0, 0.0, 0.32), (-0.5, 0.0, 0.0, 0.0, 0.0, 0.32),
    (0.0, 0.5, 0.0, 0.0, 0.0, 0.32), (0.0, -0.5, 0.0, 0.0, 0.0, 0.32), (0.3, 0.3, 0.1, -0.12, -0.08, 0.42),
    (-0.3, 0.3, -0.1, 0.12, -0.08, 0.42), (0.3, -0.3, 0.2, -0.12, 0.08, 0.42), (-0.3, -0.3, -0.2, 0.12, 0.08, 0.42),
    (0.2, 0.0, 0.3, 0.0, 0.0, 0.75), (0.4, 0.4, 0.0, 0.05, 0.05, 0.5), (-0.4, 0.2, 0.0, -0.1, 0.0, 0.5),
    (0.1, -0.6, 0.0, 0.1, 0.0, 0.45), (-0.6, 0.1, 0.1, 0.0, 0.05, 0.45),
]  # fmt: skip
"""Rotation vector [rad] and the centre of the board [m] in the frame of the camera."""


@cache
def rays(size: tuple[int, int]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return directions(LENS, BARREL, size)


@cache
def picture(pose: tuple[float, ...], size: tuple[int, int] = SIZE) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """The board through the lens: where the ray of each pixel meets the board."""
    dots = 40  # per square
    board = BOARD.pattern.generateImage((BOARD.columns * dots, BOARD.rows * dots))
    board = cv2.copyMakeBorder(board, dots, dots, dots, dots, cv2.BORDER_CONSTANT, value=255)
    rotation = cv2.Rodrigues(np.array(pose[:3]))[0]
    directions = rays(size) @ rotation  # in the frame of the board
    origin = -rotation.T @ np.array(pose[3:])
    met = (origin + directions * (-origin[2] / directions[:, 2])[:, None]) / (BOARD.square / 1000) * dots
    at = met[:, :2] + np.array([BOARD.columns, BOARD.rows]) * dots / 2 + dots - 0.5
    x, y = at.reshape(size[1], size[0], 2).astype(np.float32).transpose(2, 0, 1).copy()
    seen = cv2.remap(board, x, y, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    return np.asarray(cv2.GaussianBlur(seen, (3, 3), 0.7), np.uint8)


@cache
def seen(pose: tuple[float, ...], name: str, size: tuple[int, int] = SIZE) -> View | None:
    return find(picture(pose, size), BOARD, name)


def made(poses: Any = POSES, size: tuple[int, int] = SIZE) -> list[View]:
    views = [seen(pose, f"view {number}", size) for number, pose in enumerate(poses)]
    return [view for view in views if view is not None]


def test_the_lens_is_that_of_the_pictures() -> None:
    result = solve(made())
    np.testing.assert_allclose(result.matrix[[0, 1], [0, 1]], LENS[[0, 1], [0, 1]], rtol=0.005)
    np.testing.assert_allclose(result.matrix[:2, 2], LENS[:2, 2], atol=3.0)
    assert abs(result.distortion[0] - BARREL[0]) < 0.02
    assert result.rms < 0.2
    assert not result.dropped


@settings(max_examples=8)
@given(
    focal=st.floats(350, 900), flat=st.floats(0.97, 1.03), x=st.floats(300, 340), y=st.floats(225, 255),
    k1=st.floats(-0.3, 0.1), seed=st.integers(0, 100),
)  # fmt: skip
def test_any_common_lens_is_found_from_noisy_corners(
    focal: float, flat: float, x: float, y: float, k1: float, seed: int
) -> None:
    lens = np.array([[focal, 0, x], [0, focal * flat, y], [0, 0, 1]])
    noise = np.random.default_rng(seed)
    views = []
    for number, pose in enumerate(POSES):
        points = np.asarray(BOARD.pattern.getChessboardCorners(), np.float32).reshape(-1, 3)
        middle = np.array([BOARD.columns, BOARD.rows, 0.0]) * BOARD.square / 2000
        at = np.array(pose[3:]) * (focal / 560.0) ** np.array([0, 0, 1])
        rotation = cv2.Rodrigues(np.array(pose[:3]))[0]
        projected, _ = cv2.projectPoints(
            points, np.array(pose[:3]), at - rotation @ middle, lens, np.array([k1, 0, 0, 0, 0])
        )
        corners = projected.reshape(-1, 2) + noise.normal(0, 0.1, (len(points), 2))
        inside = ((corners > 0) & (corners < SIZE)).all(axis=1)
        view = View(f"{number}", SIZE, np.flatnonzero(inside).astype(np.int32), corners[inside].astype(np.float32),
                    points[inside], np.zeros(5))  # fmt: skip
        views.append(view)
    result = solve([view for view in views if len(view.ids) >= 12])
    np.testing.assert_allclose(np.diag(result.matrix)[:2], np.diag(lens)[:2], rtol=0.01)


def test_the_file_is_what_a_camera_reads(tmp_path: Path) -> None:
    result = solve(made())
    result.save(tmp_path / "lens" / "top.yaml", "top")
    info = load_info(tmp_path / "lens" / "top.yaml")(Header(7))
    assert (info.width, info.height, info.distortion_model) == (*SIZE, "plumb_bob")
    np.testing.assert_array_equal(info.k.reshape(3, 3), result.matrix)
    np.testing.assert_array_equal(info.d, result.distortion)


def test_a_view_that_does_not_fit_is_left_out_and_named() -> None:
    views = made()
    moved = np.where(views[3].points[:, :1] > 0.1, 6.0, 0.0) * np.array([1.0, 0.0])
    bent = attrs.evolve(views[3], corners=(views[3].corners + moved).astype(np.float32))
    result = solve([*views[:3], bent, *views[4:]])
    assert list(result.dropped) == ["view 3"]
    assert "left out: view 3" in "\n".join(result.lines())
    np.testing.assert_allclose(result.matrix[0, 0], LENS[0, 0], rtol=0.005)


def _parallel() -> list[View]:
    return made([(0.0, 0.0, 0.1 * n, 0.02 * n - 0.1, 0.01 * n - 0.05, 0.4 + 0.02 * n) for n in range(12)])


def _noisy() -> list[View]:
    noise = np.random.default_rng(1)
    return [
        attrs.evolve(view, corners=view.corners + noise.normal(0, 3, view.corners.shape).astype(np.float32))
        for view in made()
    ]


def _in_the_middle() -> list[View]:
    poses = [(0.5 * np.cos(n), 0.5 * np.sin(n), 0.0, 0.0, 0.0, 0.58 + 0.005 * n) for n in range(12)]
    return made(poses)


def _of_two_sizes() -> list[View]:
    return [*made()[:8], *(attrs.evolve(view, size=(320, 240)) for view in made()[8:])]


@pytest.mark.parametrize(
    ("views", "reason"),
    [
        (lambda: made()[:5], "5 views; at least 10 are needed"),
        (list, "0 views; at least 10 are needed"),
        (_parallel, r"almost parallel in all views .* tilt it to all sides"),
        (_in_the_middle, r"was seen in (11|22|33|44|56)% of the picture only"),
        (_noisy, r"fit together to 4\.\d px only"),
        (_of_two_sizes, r"differ in size \(8 of 640x480, 6 of 320x240\)"),
    ],
    ids=["few", "none", "parallel", "middle", "noisy", "sizes"],
)  # fmt: skip
def test_views_that_cannot_tell_the_lens_are_refused_with_the_reason(views: Any, reason: str) -> None:
    with pytest.raises(SensorError, match=reason):
        solve(views())


def test_the_same_place_is_taken_once_and_only_while_the_board_is_still() -> None:
    views = Views()
    first, second = made(POSES[:2])
    assert not views.add_live(first)  # whether it is still is not known yet
    assert views.add_live(first)
    assert not views.add_live(first)
    assert not views.add_live(second)  # it has just been moved
    assert views.add_live(second)
    assert not views.add_live(None)
    assert len(views.views) == 2


@pytest.mark.parametrize(
    ("turn", "edge"), [((0, -0.5), "right"), ((0, 0.5), "left"), ((0.5, 0), "lower"), ((-0.5, 0), "upper")]
)
def test_the_hint_names_the_edge_that_is_to_go_away(turn: tuple[float, float], edge: str) -> None:
    rotation = cv2.Rodrigues(np.array([*turn, 0.0]))[0]
    away = {"right": rotation[2, 0], "left": -rotation[2, 0], "lower": rotation[2, 1], "upper": -rotation[2, 1]}
    assert max(away, key=lambda name: away[name]) == edge  # its depth is the greatest
    flat = [view for view in made() if abs(view.place[3:]).max() < 0.1]
    turned = made([(*turn, 0.0, 0.0, 0.0, 0.35)])
    hints = {Views([*flat, *turned, view]).missing(10) for view in (*flat, *made())}
    assert all(f"its {edge} edge" not in hint for hint in hints)
    assert any("edge away" in hint for hint in hints)


def test_hints_lead_to_enough_views() -> None:
    views = Views()
    assert views.missing(12) == "move the board to the upper left"
    told = []
    for view in made():
        views.add(view)
        if (hint := views.missing(10)) not in told:
            told.append(hint)
    assert told == [
        "tilt the board: its left edge away from the camera",
        "tilt the board: its right edge away from the camera",
        "farther away: the board should fill a third of the picture",
        "",
    ]


def test_a_folder_of_pictures_gives_a_file(tmp_path: Path) -> None:
    folder = tmp_path / "shots"
    folder.mkdir()
    for number, pose in enumerate(POSES):
        cv2.imwrite(str(folder / f"{number:02}.png"), picture(pose))
    cv2.imwrite(str(folder / "wall.png"), np.full((480, 640), 90, np.uint8))
    out = tmp_path / "top.yaml"
    ran = CliRunner().invoke(camera, ["calibrate", str(folder), "-o", str(out)], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    assert "wall.png: too little of the board is seen" in ran.output
    assert "px reprojection error in 14 views" in ran.output
    assert load_info(out)(Header(0)).width == 640


def test_a_refused_calibration_writes_nothing(tmp_path: Path) -> None:
    for number, pose in enumerate(POSES[:3]):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(pose))
    out = tmp_path / "top.yaml"
    out.write_text("kept")
    with pytest.raises(Exception, match="3 views; at least 10 are needed"):
        CliRunner().invoke(camera, ["calibrate", str(tmp_path), "-o", str(out)], catch_exceptions=False)
    assert out.read_text() == "kept"


def test_a_live_camera_takes_pictures_by_itself(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    shown = [shot for pose in POSES for shot in [picture(pose)] * 2]

    class Opened:
        def __enter__(self) -> tuple[str, Any]:
            return "top", lambda timeout_s: shown.pop(0)

        def __exit__(self, *_: object) -> None:
            return

    monkeypatch.setattr(calibrate, "camera", lambda source, name: Opened())
    out = tmp_path / "top.yaml"
    ran = CliRunner().invoke(
        camera, ["calibrate", "0", "-o", str(out), "--views", "10", "--seconds", "20"], catch_exceptions=False
    )  # fmt: skip
    assert ran.exit_code == 0, ran.output
    assert "0 of 10 views; move the board to the upper left" in ran.output
    np.testing.assert_allclose(load_info(out)(Header(0)).k[0], LENS[0, 0], rtol=0.01)


@pytest.mark.parametrize("paper", PAPERS)
def test_a_printed_board_has_its_true_size(tmp_path: Path, paper: str) -> None:
    BOARD.save(tmp_path / "board.png", paper)
    page = Image.open(tmp_path / "board.png")
    assert page.info["dpi"] == pytest.approx((300, 300), abs=0.1)
    view = find(np.asarray(page), BOARD)
    assert view is not None
    a, b = (view.corners[view.ids.tolist().index(number)] for number in (0, 1))
    assert np.linalg.norm(a - b) / 300 * 25.4 == pytest.approx(25.0, rel=0.005)
    BOARD.save(tmp_path / "board.pdf", paper)
    box = (tmp_path / "board.pdf").read_bytes().partition(b"/MediaBox [")[2].split(b"]")[0].split()
    assert [float(number) / 72 * 25.4 for number in box[2:]] == pytest.approx(PAPERS[paper], abs=0.2)


def test_a_board_that_does_not_fit_names_the_square_that_does(tmp_path: Path) -> None:
    with pytest.raises(SensorError, match=r"does not fit on a4, .*: --square 27 does"):
        Board(square=40.0).save(tmp_path / "board.pdf", "a4")
    with pytest.raises(SensorError, match=r"board\.svg: must end in \.pdf or \.png"):
        BOARD.save(tmp_path / "board.svg", "a4")
