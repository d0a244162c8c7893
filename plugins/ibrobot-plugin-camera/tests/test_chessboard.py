"""`ibrobot camera calibrate --chessboard`: near and far, blurred and noisy, through a known lens."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, override

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_camera.commands import calibrate
from ibrobot_camera.intrinsics import chessboard
from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.intrinsics.chessboard import find_corners, windows_of
from ibrobot_camera.intrinsics.solve import solve
from ibrobot_camera.intrinsics.views import Views, find
from ibrobot_terminal.fakes import FakeGuide
from ibrobot_testing.command import command_line
from numpy.typing import NDArray

from ibrobot_core.api import SensorError
from ibrobot_core.app import RequestError

from .lens_rays import directions

type Picture = NDArray[np.uint8]

BOARD = Board()
INNER = BOARD.columns - 1, BOARD.rows - 1
LENS = np.array([[560.0, 0.0, 327.0], [0.0, 555.0, 236.0], [0.0, 0.0, 1.0]])
BARREL = np.array([-0.25, 0.08, 0.001, -0.0005, 0.0])
POSES: list[tuple[float, ...]] = [
    (0.0, 0.0, 0.0, 0.0, 0.0, 0.37), (0.5, 0.0, 0.0, 0.0, 0.0, 0.4), (-0.5, 0.0, 0.0, 0.0, 0.0, 0.4),
    (0.0, 0.5, 0.0, 0.0, 0.0, 0.4), (0.0, -0.5, 0.0, 0.0, 0.0, 0.4), (0.3, 0.3, 0.1, -0.15, -0.1, 0.53),
    (-0.3, 0.3, -0.1, 0.15, -0.1, 0.53), (0.3, -0.3, 0.2, -0.15, 0.1, 0.53), (-0.3, -0.3, -0.2, 0.15, 0.1, 0.53),
    (0.4, 0.4, 0.0, 0.06, 0.06, 0.6), (-0.4, 0.2, 0.0, -0.12, 0.0, 0.6), (0.1, -0.6, 0.0, 0.12, 0.0, 0.55),
]  # fmt: skip
"""Rotation vector [rad] and the centre of the board [m] in the frame of the camera."""
camera = command_line("camera")


@cache
def rays(shift: tuple[float, float]) -> NDArray[np.float64]:
    return directions(LENS, BARREL, (640, 480), shift)


@cache
def drawn(pose: tuple[float, ...], farther: float = 1.0) -> NDArray[np.float64]:
    """A chessboard with a white edge, the mean of four places in each pixel, shape (H, W)."""
    rotation, place = cv2.Rodrigues(np.array(pose[:3]))[0], np.array(pose[3:]) * farther
    origin, squares = -rotation.T @ place, np.array([BOARD.columns, BOARD.rows])
    total = np.zeros(640 * 480)
    for shift in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        ways = rays(shift) @ rotation
        met = (origin + ways * (-origin[2] / ways[:, 2])[:, None])[:, :2] / (BOARD.square / 1000) + squares / 2
        square = np.floor(met).astype(int)
        inside = ((square >= 0) & (square < squares)).all(axis=1)
        paper = ((square >= -1) & (square <= squares)).all(axis=1)
        total += np.where(inside, square.sum(axis=1) % 2 * 225 + 15, np.where(paper, 240, 90))
    return np.asarray(total / 4, np.float64).reshape(480, 640)


def taken(pose: tuple[float, ...], blur: float, noise: float, farther: float = 1.0) -> Picture:
    seed = np.random.default_rng(POSES.index(pose))
    noisy = cv2.GaussianBlur(drawn(pose, farther), (0, 0), blur) + seed.normal(0, noise, (480, 640))
    return np.asarray(np.clip(noisy, 0, 255), np.uint8)


def focal_error(blur: float, noise: float) -> float:
    """Of the focal lengths, as a share of them."""
    views = [find(taken(pose, blur, noise), BOARD, f"{pose}", markers=False) for pose in POSES]
    result = solve([view for view in views if view is not None])
    return float(np.abs(np.diag(result.matrix)[:2] / np.diag(LENS)[:2] - 1).max())


@pytest.mark.parametrize(("blur", "noise"), [(0.7, 1.0), (2.0, 1.0), (0.7, 8.0)], ids=["plain", "blurred", "noisy"])
def test_the_lens_is_that_of_the_pictures(blur: float, noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    error = focal_error(blur, noise)
    assert error < 0.005
    # A window of one size for all of them, as it is often copied from examples, is not better.
    monkeypatch.setattr(chessboard, "LEAST_WINDOW", 5)
    monkeypatch.setattr(chessboard, "MOST_WINDOW", 5)
    assert error < focal_error(blur, noise) + 0.0005


def corner_errors(farther: float) -> NDArray[np.float64]:
    """How far corners are from where the lens shows them [px]."""
    pose = POSES[1]
    found = find_corners(taken(pose, 0.7, 2.0, farther), INNER)
    assert found is not None
    grid = np.stack(np.meshgrid(np.arange(1, BOARD.columns), np.arange(1, BOARD.rows)), axis=2).reshape(-1, 2)
    points = np.zeros((len(grid), 3))
    points[:, :2] = (grid - np.array([BOARD.columns, BOARD.rows]) / 2) * BOARD.square / 1000
    where, _ = cv2.projectPoints(points, np.array(pose[:3]), np.array(pose[3:]) * farther, LENS, BARREL)
    return np.asarray(np.linalg.norm(found - where.reshape(-1, 2), axis=1), np.float64)


def test_a_window_does_not_reach_the_next_corners_of_a_small_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a meter, a window of 11 pixels on each side has several corners in it."""
    assert corner_errors(2.6).max() < 0.6
    monkeypatch.setattr(chessboard, "LEAST_WINDOW", chessboard.MOST_WINDOW)
    assert corner_errors(2.6).max() > 2.0


@settings(max_examples=60, deadline=None)
@given(
    width=st.floats(1, 60), height=st.floats(1, 60), turn=st.floats(-3.1, 3.1), columns=st.integers(3, 9),
    rows=st.integers(3, 7),
)  # fmt: skip
def test_a_window_is_half_of_the_way_to_the_next_corner(
    width: float, height: float, turn: float, columns: int, rows: int
) -> None:
    grid = np.stack(np.meshgrid(np.arange(columns) * width, np.arange(rows) * height), axis=2).reshape(-1, 2)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    windows = windows_of((grid @ rotation.T).astype(np.float32), (columns, rows))
    assert windows.shape == (columns * rows,)
    wanted = np.clip(min(width, height) / 2, chessboard.LEAST_WINDOW, chessboard.MOST_WINDOW)
    assert np.abs(windows - wanted).max() <= 1.0
    assert windows.max() <= wanted + 1e-3


def test_each_corner_has_the_window_of_its_own_neighbours() -> None:
    """Seen at an angle, squares are small on one side."""
    columns = np.cumsum([0, 8, 12, 16, 20, 30, 40])
    grid = np.stack(np.meshgrid(columns, np.arange(4) * 40), axis=2).reshape(-1, 2).astype(np.float32)
    assert windows_of(grid, (7, 4))[:7].tolist() == [4, 4, 6, 8, 10, 11, 11]


def test_the_first_row_begins_at_the_left_end() -> None:
    """A board that looks the same from both ends does not jump from picture to picture."""
    picture = taken(POSES[0], 0.7, 1.0)
    for each in (picture, np.ascontiguousarray(picture[::-1, ::-1])):
        corners = find_corners(each, INNER)
        assert corners is not None
        assert corners[0, 0] < corners[-1, 0]
        assert corners[0, 1] < corners[-1, 1]


def test_a_board_that_is_cut_off_is_not_seen() -> None:
    picture = taken(POSES[0], 0.7, 1.0)
    assert find(np.ascontiguousarray(picture[:, :320]), BOARD, markers=False) is None
    assert find(np.full((480, 640), 128, np.uint8), BOARD, markers=False) is None


def test_views_follow_one_another_as_with_markers() -> None:
    views = Views()
    picture = taken(POSES[0], 0.7, 1.0)
    assert not views.add_live(find(picture, BOARD, markers=False))
    assert views.add_live(find(picture, BOARD, markers=False))


def test_the_command_reads_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "side"
    folder.mkdir()
    for number, pose in enumerate(POSES):
        cv2.imwrite(str(folder / f"{number:02}.png"), taken(pose, 0.7, 1.0))
    result = CliRunner().invoke(camera, ["calibrate", str(folder), "--chessboard", "-o", str(tmp_path / "side.yaml")])
    assert result.exit_code == 0, result.output
    assert "reprojection error in 12 views" in result.output
    failed = CliRunner().invoke(camera, ["calibrate", str(folder), "-o", str(tmp_path / "none.yaml")])
    assert failed.exit_code != 0
    assert "a plain chessboard needs --chessboard" in str(failed.exception)
    assert not (tmp_path / "none.yaml").exists()


class Watching(FakeGuide):
    """Looks at the table until all pictures were shown."""

    @override
    def wait(self, request: str, *, rows: Any = None, **more: object) -> None:
        self.said.append(request)
        for _ in range(3 * len(POSES)):
            self.tables.append(rows())


@pytest.mark.parametrize("marked", [False, True])
def test_the_page_takes_a_plain_chessboard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, marked: bool) -> None:
    shown = iter([pose for pose in POSES for _ in range(3)])  # still for a moment each

    @contextmanager
    def camera_of(source: str) -> Iterator[tuple[str, Any]]:
        yield "side", lambda timeout_s: taken(next(shown), 0.7, 1.0)

    monkeypatch.setattr(calibrate, "camera", camera_of)
    answers: dict[str, str | bool] = {
        "camera": "side", "file": str(tmp_path / "side.yaml"), "squares": "10x7", "square": "25",
        "chessboard": not marked,
    }  # fmt: skip
    assert {each.name for each in calibrate.questions()} == set(answers)
    guide = Watching()
    if marked:
        with pytest.raises(SensorError, match="0 views; at least 10 are needed"):
            calibrate.guided(answers, guide)
        return
    calibrate.guided(answers, guide)
    assert guide.tables[-1][0][0] == "12"
    assert guide.said[-1].endswith(f"info: {tmp_path}/side.yaml")


@pytest.mark.parametrize("changes", [{"squares": "10"}, {"squares": "3 x 7"}, {"square": "wide"}, {"square": "-1"}])
def test_a_board_that_makes_no_sense_is_named(changes: dict[str, str]) -> None:
    with pytest.raises(RequestError, match="give its squares as 10 x 7, and their side in mm"):
        calibrate.board_of({"squares": "10 x 7", "square": "25", **changes})


@pytest.mark.parametrize("squares", ["8x6", " 8 X 6 ", "8 \u00d7 6", "8*6"])
def test_squares_are_read_as_people_write_them(squares: str) -> None:
    board = calibrate.board_of({"squares": squares, "square": "25"})
    assert (board.columns, board.rows) == (8, 6)


@pytest.mark.parametrize("squares", ["", "10", "10 x 7 x 3", "ten x 7", "9" * 5000 + " x 7"])
def test_squares_that_are_no_pair_are_shown_as_they_were_typed(squares: str) -> None:
    with pytest.raises(RequestError) as refused:
        calibrate.board_of({"squares": squares, "square": "25"})
    assert str(refused.value).startswith(f"the board: its squares are {squares[:40]!r}; give its squares as 10 x 7")
