"""Rigs with cameras that look at a made scene, in which objects and an arm move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import numpy as np
from ibrobot_diagnose.card import Card, make_card
from ibrobot_diagnose.cause import Diagnosis, Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.recorded_rig import rig_of
from ibrobot_diagnose.rig import Rig, RigCamera, Still
from ibrobot_diagnose.window import Window
from made_runs import HOME, JOINTS, Run, window_of
from numpy.typing import NDArray

TOP, WRIST = "observation.images.top", "observation.images.wrist"
HEIGHT, WIDTH = 240, 320
CALIBRATION = {
    "arm": {
        joint: {"id": number, "drive_mode": 0, "homing_offset": 0, "range_min": 200, "range_max": 3900}
        for number, joint in enumerate(JOINTS, 1)
    }
}

type Picture = NDArray[np.uint8]


@attrs.frozen(kw_only=True)
class Scene:
    """A table with things on it, before a camera."""

    camera: str = "top"
    plain: bool = False
    """Whether there is nothing on the table."""
    shift: tuple[float, float] = (0.0, 0.0)
    """By how much the camera has moved [pixels of its picture]."""
    roll: float = 0.0
    light: float = 1.0
    objects: int = 0
    """Seed of the places of what moves."""
    arm: float = 0.0
    """Where the arm stands [rad]."""
    width: int = 18
    """Half of the arm's width [pixels]."""
    noise: int = 1
    made: Callable[[Picture], Picture] = lambda picture: picture
    """What becomes of the picture."""

    def picture(self) -> Picture:
        """The picture, shape (240, 320, 3)."""
        table = _table(self.camera, self.plain)
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
        y, x = rows - HEIGHT / 2, columns - WIDTH / 2
        c, s = np.cos(self.roll), np.sin(self.roll)
        at_x = _MARGIN + WIDTH / 2 + c * x - s * y + self.shift[0]
        at_y = _MARGIN + HEIGHT / 2 + s * x + c * y + self.shift[1]
        x0, y0 = np.floor(at_x).astype(int), np.floor(at_y).astype(int)
        fx, fy = (at_x - x0)[..., None], (at_y - y0)[..., None]
        upper = table[y0, x0] * (1 - fx) + table[y0, x0 + 1] * fx
        lower = table[y0 + 1, x0] * (1 - fx) + table[y0 + 1, x0 + 1] * fx
        seen = upper * (1 - fy) + lower * fy
        rng = np.random.default_rng(self.objects + 100)
        for _ in range(2):
            oy, ox = (int(each) for each in rng.integers((30, 30), (HEIGHT - 60, WIDTH - 60)))
            seen[oy : oy + 26, ox : ox + 26] = rng.uniform(30, 220, 3)
        arm = self.moving(room=0)
        seen[arm] = (50, 50, 58)
        seen[arm & (np.arange(HEIGHT) // 9 % 2 == 0)[:, None]] = (190, 160, 40)
        rng = np.random.default_rng(self.noise)
        return self.made(np.clip(seen * self.light + rng.normal(0, 1.5, seen.shape), 0, 255).astype(np.uint8))

    def moving(self, room: int = 4) -> NDArray[np.bool_]:
        """Where the arm is, with some pixels around it."""
        mask = np.zeros((HEIGHT, WIDTH), np.bool_)
        middle = int(WIDTH * (0.5 + 0.3 * self.arm))
        mask[60 - room :, max(0, middle - self.width - room) : middle + self.width + room] = True
        return mask

    def still(self, *, masked: bool = True, reads: float | None = None) -> Still:
        """A still; `reads`: what the arm says of where it stands, if that is wrong."""
        pose = np.array([self.arm if reads is None else reads, *HOME[1:]])
        return Still(self.picture(), pose, self.moving() if masked else None)


_MARGIN = 120
_TABLES: dict[tuple[str, bool], NDArray[np.float64]] = {}


def _table(camera: str, plain: bool) -> NDArray[np.float64]:
    if (camera, plain) not in _TABLES:
        rng = np.random.default_rng(sum(map(ord, camera)))
        height, width = HEIGHT + 2 * _MARGIN, WIDTH + 2 * _MARGIN
        table = np.full((height, width, 3), (150.0, 130.0, 105.0) if camera == "top" else (95.0, 112.0, 128.0))
        for _ in range(0 if plain else 220):
            y, x, h, w = (int(each) for each in rng.integers(0, (height, width, 40, 46)))
            table[y : y + h + 6, x : x + w + 6] = rng.uniform(40, 210, 3)
        _TABLES[camera, plain] = table
    return _TABLES[camera, plain]


def rig(*stills: Still, stands: bool | None = True, more: dict[str, Still] | None = None, **changes: Any) -> Rig:
    """A rig with a camera `top`, or several."""
    cameras = {TOP: stills} if stills else {}
    cameras |= {key: (still,) for key, still in (more or {}).items()}
    made = Rig(
        "arm", "2026-01-01T12:00:00+00:00", JOINTS,
        {
            key: RigCamera((480, 640), tuple(each), 30.0, {"exposure": 100}, 0.98, stands)
            for key, each in cameras.items()
        },
        loop_hz=100.0, asked_hz=100.0, calibration=CALIBRATION, versions={"ibrobot-core": "0.1.0"}, fingerprint="f",
    )  # fmt: skip
    return attrs.evolve(made, **changes)


_BASE: list[Window] = []


def window(of: Rig) -> Window:
    """A window on a rig at rest."""
    if not _BASE:
        _BASE.append(window_of(Run(acts=False, seconds=2, amplitude=0.0, cameras=("top",))))
    assert rig_of(_BASE[0]) is not None
    return attrs.evolve(_BASE[0], rig=of)


def card(of: Rig) -> Card:
    """The card of a rig."""
    return make_card([window(of)])


def compared(now: Rig, then: Rig) -> Diagnosis:
    """What the causes say of two rigs."""
    return diagnose(window(now), Reference(card(then)))


def verdicts(now: Rig, then: Rig) -> dict[str, str]:
    """Cause -> verdict, of those that are not well."""
    return unwell(compared(now, then))


def unwell(diagnosis: Diagnosis) -> dict[str, str]:
    """Cause -> verdict, of those that are not well."""
    listed = (*diagnosis.findings, *diagnosis.measured)
    return {each.name: each.evidence.verdict for each in listed if each.evidence.verdict != "ok"}
