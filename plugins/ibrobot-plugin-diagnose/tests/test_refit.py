"""The guide that puts a camera back: what it shows, and where it says to turn the camera."""

from __future__ import annotations

import io

import numpy as np
import pytest
from ibrobot_diagnose.causes.moved import Sight, sights
from ibrobot_diagnose.refit import overlay, questions, turns
from made_rigs import Scene, rig
from PIL import Image

from ibrobot_core.api import IbrobotError


def sight(**options: object) -> Sight:
    then, now = (rig(scene.still()) for scene in (Scene(), Scene(**options)))  # type: ignore[arg-type]
    (seen,) = sights(now, then)
    return seen


@pytest.mark.parametrize(
    ("options", "ways"),
    [
        ({"shift": (-8.0, 0.0)}, "turn it right"),
        ({"shift": (8.0, 0.0)}, "turn it left"),
        ({"shift": (0.0, -6.0)}, "turn it down"),
        ({"shift": (6.0, 6.0)}, "turn it left and up"),
        ({"roll": 0.05}, "roll it counterclockwise by 2.9°"),
        ({"roll": -0.05}, "roll it clockwise by 2.9°"),
    ],
)
def test_the_camera_is_turned_where_its_picture_has_gone(options: dict[str, object], ways: str) -> None:
    assert turns(sight(**options)) == ways


def test_lines_are_where_things_were() -> None:
    then = np.full((60, 80, 3), 90, np.uint8)
    then[20:40, 20:40] = 200
    now = np.roll(then, 25, axis=1)
    shown = np.asarray(Image.open(io.BytesIO(overlay(then, now))), np.int64)
    red = shown[..., 0] - shown[..., 1] > 80
    assert red[20:40, 19:21].all(axis=1).mean() > 0.8
    assert not red[:, 50:].any()
    assert shown[30, 55].min() > 150  # what is seen now
    with pytest.raises(IbrobotError, match="have 80x60 pixels, those of the reference 40x30"):
        overlay(then[::2, ::2], now)


def test_it_asks_for_robot_reference_and_camera() -> None:
    assert [each.name for each in questions()] == ["robot", "against", "camera", "simulated"]
