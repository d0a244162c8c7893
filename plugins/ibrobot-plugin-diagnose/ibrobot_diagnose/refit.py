"""Guide for pages: a camera that has moved is put back, with the pictures of then and now over one another."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import attrs
import numpy as np
from ibrobot_terminal import Guide, Question
from numpy.typing import NDArray
from PIL import Image

from ibrobot_core.api import HardwareError, IbrobotError
from ibrobot_core.app import RobotConfig, Runtime, find_config, installed_plugins, load_config
from ibrobot_diagnose.arm_view import with_moving
from ibrobot_diagnose.causes.moved import WARNS, Sight, sights
from ibrobot_diagnose.live import looking
from ibrobot_diagnose.pictures import grey
from ibrobot_diagnose.references import reference_of
from ibrobot_diagnose.rig import Rig
from ibrobot_diagnose.watch import LiveWindow, Watch

_EVERY_S = 0.2
"""Time between two pictures [s]."""
_EDGE = 10.0
"""Gradient of the grey values from which a line is drawn."""
_LEAST_WAY = 1.0
"""Displacement from which a direction is named [pixels of 640]."""
_LEAST_ROLL = 0.005
"""Turn in the picture's plane from which it is named [rad]."""


def questions() -> Sequence[Question]:
    """Which robot, reference and camera."""
    return (
        Question("robot", "Robot YAML", "so101"),
        Question("against", "Reference, dataset or checkpoint", "rig.json"),
        Question("camera", "Camera", "top"),
        Question("simulated", "Use its simulation", default=False),
    )


def refit(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Show a camera's picture over that of a reference until an operator has put it back. Nothing moves.

    Raises:
        IbrobotError: if the robot or the reference cannot be read, or the camera is not in both.
    """
    config = load_config(find_config(str(answers["robot"]), installed_plugins()), sim=bool(answers["simulated"]))
    card = reference_of(Path(str(answers["against"])).expanduser())
    assert card.rig is not None
    name = str(answers["camera"])
    known = [key for key in card.rig.cameras if key.rpartition(".")[2] == name]
    if not known:
        there = ", ".join(key.rpartition(".")[2] for key in card.rig.cameras) or "none"
        raise HardwareError(f"the reference has no camera {name!r}; it has: {there}")
    with looking(config) as (runtime, watch), closing(Refit(config, card.rig, known[0], runtime, watch)) as fitting:
        guide.wait(
            "Turn the camera until what it sees lies on the red lines: they are where things were in the reference.",
            columns=("camera", ">shift [px of 640]", "what to do"), rows=fitting.rows, sight=fitting.picture,
        )  # fmt: skip
        guide.say(fitting.verdict, warning=not fitting.fits)


class Refit:
    """A camera that is compared with its picture in a reference, again and again.

    Args:
        config: the robot.
        then: the rig of the reference.
        key: the observation of the camera.
        runtime: a run in which nothing moves.
        watch: what it shows.
    """

    def __init__(self, config: RobotConfig, then: Rig, key: str, runtime: Runtime, watch: Watch) -> None:
        self._config, self._then, self._key = config, attrs.evolve(then, cameras={key: then.cameras[key]}), key
        self._runtime, self._watch = runtime, watch
        self._worker = ThreadPoolExecutor(1, "refit")
        self._measuring: Future[Sight] | None = None
        self._sight: Sight | None = None
        self._shown: NDArray[np.uint8] | None = None
        self._next_s = 0.0
        watch.begin()

    def close(self) -> None:
        """End the comparison."""
        self._worker.shutdown(cancel_futures=True)

    @property
    def fits(self) -> bool:
        """Whether the camera surely stands as in the reference."""
        return self._sight is not None and self._sight.stays

    @property
    def verdict(self) -> str:
        """What is known of the camera, in a sentence."""
        return "The camera was not compared yet." if self._sight is None else self._sight.text

    def rows(self) -> list[list[str]]:
        """How far the camera is from its place, and where to turn it.

        Raises:
            IbrobotError: if the run ends.
        """
        if self._runtime.wait(0.0):
            self._runtime.raise_failure()
            raise HardwareError("the run ended")
        if self._measuring is not None and self._measuring.done():
            self._sight, self._measuring = self._measuring.result(), None
        if time.monotonic() >= self._next_s and (seen := self._seen()) is not None:
            self._next_s = time.monotonic() + _EVERY_S
            if self._measuring is None:
                self._measuring = self._worker.submit(self._measured, seen)
        return [self._row()]

    def picture(self) -> bytes | None:
        """The picture of now over that of then, as JPEG; None before the first, and if there is no newer one."""
        shown, self._shown = self._shown, None
        return None if shown is None else overlay(self._then.cameras[self._key].stills[-1].picture, shown)

    def _seen(self) -> LiveWindow | None:
        """What was seen since the last time; None if that is nothing yet."""
        seen = self._watch.window()
        camera = seen.rig.cameras.get(self._key)
        if camera is None:
            return None
        self._shown = camera.stills[-1].picture
        self._watch.begin()
        return seen

    def _measured(self, seen: LiveWindow) -> Sight:
        now = attrs.evolve(seen.rig, cameras={self._key: seen.rig.cameras[self._key]})
        now, then, _ = with_moving((now, self._then), self._config, seen.infos)
        return sights(now, then)[0]

    def _row(self) -> list[str]:
        name, sight = self._key.rpartition(".")[2], self._sight
        if sight is None or sight.moved is None:
            return [name, "", "" if sight is None else sight.unclear]
        if sight.unclear:
            return [name, "", f"uncertain: {sight.unclear}"]
        return [name, f"{sight.pixels:.1f}", "it fits" if sight.stays else turns(sight)]


def turns(sight: Sight) -> str:
    """How to turn a camera, as seen from behind it."""
    assert sight.moved is not None
    if sight.moved.is_other_view:
        return "it shows another view"
    (right, down), roll = sight.moved.way, sight.moved.roll
    ways = [
        word for way, word in ((right, "right"), (-right, "left"), (down, "down"), (-down, "up")) if way > _LEAST_WAY
    ]
    actions = [f"turn it {' and '.join(ways)}"] if ways else []
    if abs(roll) > _LEAST_ROLL:
        side = "clockwise" if roll > 0 else "counterclockwise"
        actions.append(f"roll it {side} by {abs(np.degrees(roll)):.1f}°")
    return ", ".join(actions) or f"move it until it fits to {WARNS:g} px"


def overlay(then: NDArray[np.uint8], now: NDArray[np.uint8]) -> bytes:
    """The picture of now with the edges of the picture of then in red, as JPEG.

    Raises:
        IbrobotError: if their sizes differ.
    """
    if then.shape != now.shape:
        sizes = [f"{each.shape[1]}x{each.shape[0]}" for each in (now, then)]
        raise IbrobotError(f"the pictures have {sizes[0]} pixels, those of the reference {sizes[1]}")
    edges = np.hypot(*np.gradient(grey(then))) > _EDGE
    shown = now.copy()
    shown[edges] = (255, 0, 0)
    file = io.BytesIO()
    Image.fromarray(shown).save(file, "JPEG", quality=90, subsampling=0)
    return file.getvalue()
