"""What the stills of two rigs say of each camera: whether it has moved, and whether the arm looks as it did."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.alignment import Moved, in_place_of, moved_of
from ibrobot_diagnose.looks import Looks, looks_of
from ibrobot_diagnose.pictures import Grey, grey
from ibrobot_diagnose.rig import Floats, Rig, RigCamera, Still

WARNS, FAILS = 3.0, 5.0
"""Displacements from which a camera has moved [pixels of 640]."""
_SAME = 0.02
"""Difference of all joints below which the arm stands as before [rad]."""
_SAME_ON_ARM = 0.003
"""The same for a camera on the arm [rad]: it turns with the arm."""
_AGREE = 3
"""Stills of now that are compared, of which the middle one counts."""


@attrs.frozen(eq=False)
class Sight:
    """What is known of a camera of two rigs."""

    name: str
    moved: Moved | None
    """None if it cannot be compared."""
    unclear: str
    """Why it is uncertain whether it has moved; empty if it is not."""
    masked: bool
    """Whether the arm was drawn, so that it counts for nothing."""
    focal: float | None
    then: NDArray[np.uint8]
    now: NDArray[np.uint8]
    turned: Floats | None
    """Positions of the joints less those of the reference [rad], shape (J,); None if unknown."""
    looks: Looks | None = None
    """None if its pictures cannot be compared."""
    arm_rich: int = 0
    """Number of areas of the picture in which the arm can be seen; 0 if it is not known where it is."""
    arm_found: int = 0
    """Number of these that look as they did."""

    @property
    def stays(self) -> bool:
        """Whether the camera surely stands where it stood."""
        return self.moved is not None and not self.unclear and self.moved.pixels < WARNS

    @property
    def pixels(self) -> float:
        """How far it has moved; at least `FAILS` if it shows another view."""
        assert self.moved is not None
        return max(self.moved.pixels, FAILS) if self.moved.is_other_view else self.moved.pixels

    @property
    def text(self) -> str:
        """A sentence on it."""
        how = "" if self.masked else ", without a mask of the arm"
        if self.moved is None or self.unclear:
            return f"Whether the camera {self.name} has moved is uncertain: {self.unclear}."
        moved = self.moved
        if moved.is_other_view:
            return (
                f"The camera {self.name} shows another view: of {moved.rich} areas in which something stands still, "
                f"{moved.in_place} are in their place{how}."
            )
        turned = f", turned by {abs(np.degrees(moved.roll)):.1f}°" if abs(moved.roll) > 0.005 else ""
        if self.focal:
            turned = f" or {np.degrees(np.arctan(moved.pixels / 640 / self.focal)):.2f}°{turned}"
        verb = "has moved" if moved.pixels >= WARNS else "stands as before"
        return (
            f"The camera {self.name} {verb}: its picture is shifted by {moved.pixels:.1f} of 640 pixels{turned} "
            f"({moved.found} of {moved.rich} areas found{how})."
        )


@lru_cache(maxsize=4)
def sights(now: Rig, then: Rig) -> Sequence[Sight]:
    """The cameras that both rigs have."""
    return tuple(
        _sight(key.rpartition(".")[2], now.cameras[key], camera, same_joints=now.joints == then.joints)
        for key, camera in then.cameras.items()
        if key in now.cameras and camera.stills and now.cameras[key].stills
    )


def _sight(name: str, now: RigCamera, then: RigCamera, *, same_joints: bool) -> Sight:
    newest = now.stills[-1]
    reference, turned = then.stills[-1], None
    if same_joints:
        reference = min(then.stills, key=lambda each: _apart(each.pose, newest.pose))
        difference = newest.pose - reference.pose
        turned = difference if np.isfinite(difference).all() else None
    stands = now.stands if now.stands is not None else then.stands
    masked = reference.moving is not None and all(each.moving is not None for each in now.stills)
    focal = now.focal or then.focal
    known = name, None, "", masked, focal, reference.picture, newest.picture, turned
    if reference.picture.shape != newest.picture.shape:
        return attrs.evolve(Sight(*known), unclear="its pictures have another size")
    apart = np.inf if turned is None else float(np.abs(turned).max())
    same = apart < (_SAME_ON_ARM if stands is False else _SAME)
    # What stands still shows it: all of the picture if the arm stands as before, otherwise what is not the arm.
    mask = masked and not (same and stands is not False)
    each_moved = [_moved(reference, each, mask=mask) for each in now.stills[-_AGREE:]]
    moved = sorted(each_moved, key=lambda each: each.pixels)[len(each_moved) // 2]
    unclear = moved.unclear
    in_place = moved.pixels < WARNS and moved.in_place >= max(4, 0.5 * moved.rich)
    if not mask and not same and stands is not True and not in_place:
        unclear = (
            "the arm stands elsewhere than in the reference, and the camera may be on it: put the arm into that pose, "
            "or give the camera its `transform`"
        )
    weights = [_weight(each, mask=mask) for each in (reference, newest)]
    # A camera on the arm sees another part of the scene if the arm stands elsewhere, and its own link in other light.
    looks = looks_of(reference.picture, newest.picture, weights[0] * weights[1]) if same or stands else None
    sight = attrs.evolve(Sight(*known), moved=moved, unclear=unclear, looks=looks)
    if reference.moving is None or stands is False:
        return sight
    rich, alike = in_place_of(_grey(reference), _grey(newest), reference.moving.astype(np.float32))
    return attrs.evolve(sight, arm_rich=rich, arm_found=alike)


def _apart(one: Floats, other: Floats) -> float:
    far = np.abs(one - other)
    return float(far.max()) if np.isfinite(far).all() else np.inf


def _grey(still: Still) -> Grey:
    return grey(still.picture)


def _weight(still: Still, *, mask: bool) -> Grey:
    """1 for what stands still, shape (H, W)."""
    if mask and still.moving is not None:
        return 1.0 - still.moving.astype(np.float32)
    return np.ones(still.picture.shape[:2], np.float32)


def _moved(then: Still, now: Still, *, mask: bool) -> Moved:
    return moved_of(_grey(then), _grey(now), _weight(then, mask=mask), _weight(now, mask=mask))
