"""`ibrobot camera board` and `ibrobot camera calibrate`: the intrinsics of a camera."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import attrs
import cv2
import numpy as np
from ibrobot_terminal import Guide, Question
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_camera.intrinsics.board import PAPERS, Board
from ibrobot_camera.intrinsics.solve import FEWEST_VIEWS, Intrinsics, solve
from ibrobot_camera.intrinsics.views import View, Views, find
from ibrobot_core.api import SensorError, option
from ibrobot_core.app import RequestError, echo, wrong_input

VIEWS = 20
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp")
_HINT_S = 2.0
"""Least time between two hints [s]."""
_BOARD = Path("board.pdf")
_PRINT = "Print it at 100 %, measure a row of squares, and glue it onto something flat and stiff."
_SQUARES = re.compile(r"\s*(\d{1,3})\s*[xX\u00d7*]\s*(\d{1,3})\s*")

type Read = Callable[[float], NDArray[np.uint8] | None]
"""Waits for a picture up to a time [s]; grey or BGR."""


@attrs.frozen(kw_only=True)
class MakeBoard(Board):
    """Make a page with a board for `ibrobot camera calibrate`.

    Print it at 100 %, without fitting it to the page, and glue it onto something flat and stiff. Then measure a row of
    squares, and give the side of one to `--square` if it differs.
    """

    output: Path = option(_BOARD, typed="-o FILE", help="a .pdf or .png file")
    paper: str = option("a4", choices=tuple(PAPERS), help="size of the paper")

    def __call__(self) -> None:
        with wrong_input():
            self.save(self.output, self.paper)
        echo(f"{self.output}: {self.columns}x{counted(self.rows, 'square')} of {self.square:g} mm on {self.paper}")
        echo(_PRINT)


@attrs.frozen(kw_only=True)
class CalibrateCamera(Board):
    """Measure the lens of a camera with a printed board; see `ibrobot camera board`.

    With --chessboard, a plain chessboard does; --columns and --rows count its squares, not its inner corners.

    SOURCE is a device, a robot YAML with one `opencv` camera or with --camera, or a folder of pictures. Of a camera,
    pictures are taken by themselves while you show the board: hold it still for a moment in each place. The focus must
    not change afterwards, so switch autofocus off before.

    The result is a file for the option `info` of the camera. It is not written if the views cannot tell the lens.
    """

    source: str = option(typed="SOURCE", help="a device, a robot YAML, or a folder of pictures")
    camera: str = option("", help="the camera of the robot YAML, if it has several")
    output: Path | None = option(
        None, typed="-o FILE", help="the file to write, by default NAME.yaml; it is replaced if it exists"
    )
    chessboard: bool = option(False, help="the board is a plain chessboard without markers; show all of it")
    views: int = option(VIEWS, ge=FEWEST_VIEWS, le=200, help="number of views to take")
    seconds: float = option(300.0, gt=0, unit="s", help="time after which the views that were taken must suffice")

    def __call__(self) -> Intrinsics:
        with wrong_input():
            if Path(self.source).is_dir():
                name, views = Path(self.source).name, self._of_folder(Path(self.source))
            else:
                with camera(self.source, self.camera) as (name, read):
                    views = self._live(read)
            result = solve(views)
            output = self.output or Path(f"{name}.yaml")
            result.save(output, name)
            echo(f"{output}: {result.size[0]}x{result.size[1]}; put it into the robot YAML: info: {output}")
        return result

    def show(self, result: Intrinsics) -> None:
        """Print the result."""
        for line in result.lines():
            echo(line)

    def _of_folder(self, folder: Path) -> list[View]:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in _PICTURES)
        if not paths:
            raise SensorError(f"{folder}: has no pictures ({', '.join(_PICTURES)})")
        views = []
        for path in paths:
            picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if picture is None:
                raise SensorError(f"{path}: is not a picture that can be read")
            if (view := self._find(np.asarray(picture, np.uint8), path.name)) is not None:
                views.append(view)
            else:
                echo(f"{path.name}: too little of the board is seen", err=True)
        if not views:
            corners = f"{self.columns - 1} x {self.rows - 1} inner corners"
            seen = f"chessboard with {corners}" if self.chessboard else f"board with markers and {corners}"
            other = "" if self.chessboard else ", and a plain chessboard needs --chessboard"
            raise SensorError(f"{folder}: no picture shows a {seen}; --columns and --rows count squares{other}")
        return views

    def _find(self, picture: NDArray[np.uint8], name: str) -> View | None:
        return find(picture, self, name, markers=not self.chessboard)

    def _live(self, read: Read) -> list[View]:
        views, hint, told_s, end_s = Views(), "", 0.0, time.monotonic() + self.seconds
        while (now_s := time.monotonic()) < end_s and (missing := views.missing(self.views)):
            if missing != hint and now_s > told_s + _HINT_S:
                hint, told_s = missing, now_s
                echo(f"{len(views.views)} of {counted(self.views, 'view')}; {hint}")
            picture = read(min(1.0, end_s - now_s))
            if picture is not None and views.add_live(self._find(picture, f"view {len(views.views) + 1}")):
                echo("\a", nl=False)
        return views.views


@contextmanager
def camera(source: str, name: str = "") -> Iterator[tuple[str, Read]]:
    """Open one camera; yields its name and a function that reads pictures.

    Raises:
        SensorError: if it does not open.
        RequestError: if the robot YAML has no camera `name`, or several and `name` is empty.
    """
    from ibrobot_camera.commands.sources import decoded, opened, pixels

    with opened(source, name) as cameras:
        ((name, opened_camera),) = cameras.items()

        def read(timeout_s: float) -> NDArray[np.uint8] | None:
            message = opened_camera.read(timeout_s)
            return None if message is None else np.asarray(pixels(decoded(message)), np.uint8)

        yield name, read


def size_questions() -> tuple[Question, ...]:
    """Questions about the size of a board, whose answers `board_of` reads."""
    return (
        Question("squares", "Squares of the board, columns x rows", "10 x 7"),
        Question("square", "Side of a square of the printed board [mm]", "25"),
    )


def board_questions() -> tuple[Question, ...]:
    """Of the guide that makes a board."""
    return (
        *size_questions(),
        Question("paper", "Paper", next(iter(PAPERS)), tuple(PAPERS)),
        Question("file", "File to write", str(_BOARD)),
    )


def make_board(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Make a board from a page.

    Raises:
        IbrobotError: if an answer makes no sense, the paper is too small, or the file cannot be written.
    """
    board, path, paper = board_of(answers), Path(str(answers["file"]).strip()), str(answers["paper"])
    board.save(path, paper)
    small = cv2.resize(board.page(paper), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    guide.picture("the page", bytes(cv2.imencode(".png", small)[1].tobytes()))
    guide.say(f"{path.absolute()} is written.")
    guide.say(_PRINT)


def questions() -> tuple[Question, ...]:
    """Of the guide for pages."""
    from ibrobot_camera import v4l2

    names = tuple(each.lasting_name or each.path for each in v4l2.cameras())
    return (
        Question("camera", "Camera", names[0] if names else "", names, open=True),
        Question("file", "File to write", "camera.yaml"),
        *size_questions(),
        Question("chessboard", "The board is a plain chessboard, without markers", default=False),
    )


def board_of(answers: Mapping[str, str | bool]) -> Board:
    """The board that an operator has, by the answers `squares` and `square`.

    Raises:
        RequestError: if they make no sense.
    """
    typed = str(answers["squares"])
    squares = _SQUARES.fullmatch(typed)
    try:
        if squares is None:
            raise ValueError(f"its squares are {typed[:40]!r}")
        return Board(columns=int(squares[1]), rows=int(squares[2]), square=float(answers["square"]))
    except ValueError as error:
        raise RequestError(f"the board: {error}; give its squares as 10 x 7, and their side in mm") from None


def guided(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Calibrate a camera from a page.

    Raises:
        IbrobotError: if an answer makes no sense, the camera does not open, or its views cannot tell the lens.
    """
    board, markers = board_of(answers), answers["chessboard"] is not True
    views, picture = Views(), np.zeros((1, 1), np.uint8)
    with camera(str(answers["camera"])) as (name, read):

        def rows() -> list[list[str]]:
            nonlocal picture
            if (taken := read(0.02)) is not None:
                picture = taken
                views.add_live(find(taken, board, f"view {len(views.views) + 1}", markers=markers))
            return [[str(len(views.views)), views.missing(VIEWS) or "enough: go on"]]

        guide.wait(
            "Show the board as the table says, still for a moment each.",
            columns=(">views", "next"), rows=rows, sight=lambda: _with_corners(picture, views.views),
        )  # fmt: skip
    if views.views:
        guide.picture("corners of all views", _with_corners(picture, views.views))
    result, path = solve(views.views), Path(str(answers["file"]))
    result.save(path, name)
    for line in result.lines():
        guide.say(line)
    guide.say(f"{path} is written; put it into the robot YAML: info: {path}")


def _with_corners(picture: NDArray[np.uint8], views: Sequence[View]) -> bytes:
    """A picture, grey or BGR, with the corners of all views, as JPEG."""
    shown = cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR) if picture.ndim == 2 else picture.copy()
    for view in views:
        for x, y in view.corners.tolist():
            cv2.circle(shown, (round(x), round(y)), 2, (0, 0, 255), -1)
    return bytes(cv2.imencode(".jpg", shown)[1].tobytes())
