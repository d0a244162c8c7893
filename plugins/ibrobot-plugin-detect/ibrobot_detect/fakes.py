"""The smallest detector that looks at pictures, for tests and for new packages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

import numpy as np
from ibrobot_kinematics.poses import pose_at

from ibrobot_detect.detector import Detection, Detector, Seen, Sight, fits

_COLOURS = {"red thing": 0, "blue thing": 2}
"""Name -> its channel in pictures."""


class FakeDetector(Detector):
    """Finds a red and a blue thing on the table, which is the plane z = 0 of the base frame.

    Args:
        share: least share of its own colour in a pixel of a thing.
    """

    def __init__(self, share: float = 0.6) -> None:
        self._share = share

    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        wanted = fits(name, list(_COLOURS)) if name else list(_COLOURS)
        seen = [_on_table(each, sight, self._share) for each in wanted for sight in sights]
        best = {each.name: each for each in sorted(filter(None, seen), key=lambda each: each.score)}
        return sorted(best.values(), key=lambda each: -each.score)


def _on_table(name: str, sight: Sight, share: float) -> Detection | None:
    """The thing of a colour in a picture, where the ray through its middle meets the table; None without one."""
    assert sight.pixels is not None
    picture = sight.pixels.astype(float)
    light = picture.sum(axis=2)
    mask = (light > 60) & (picture[..., _COLOURS[name]] > share * light)
    y, x = np.nonzero(mask)
    if len(x) < 10 or len(x) < 0.5 * (np.ptp(x) + 1) * (np.ptp(y) + 1):  # nothing, or no thing of its own
        return None
    ray = sight.pose[:3, :3] @ np.linalg.solve(sight.intrinsics, [x.mean(), y.mean(), 1.0])
    if ray[2] >= 0:
        return None
    place = sight.pose[:3, 3] - ray * sight.pose[2, 3] / ray[2]
    box = (float(x.min()), float(y.min()), float(x.max()), float(y.max()))
    score = round(float(picture[mask][:, _COLOURS[name]].mean() / 255), 3)
    return Detection(name, pose_at(place.tolist()), score=score, seen=(Seen(sight.camera, box),))
