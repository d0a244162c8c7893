"""Options of the guard `clearance`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal

import attrs

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, option
from ibrobot_planning.world.options import link_names, near

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

BASE = "base"
"""The name of a base in messages."""
LEAST_M = 0.001
"""Minimum margin [m]: a pair can come 0.9 mm nearer than its margin between two configurations that were measured."""
_LARGEST_BASE_M = 10.0
_THINNEST_M = 1e-3
"""Coal ends the process when it makes the hull of a body whose thickness is lost in rounding."""


def _corners(instance: object, attribute: attrs.Attribute[Any], value: tuple[tuple[float, float], ...]) -> None:
    if len(value) < 3 or not all(abs(number) <= _LARGEST_BASE_M for corner in value for number in corner):
        raise ValueError(f"must be three corners or more, each x and y within {_LARGEST_BASE_M:g} m, got {list(value)}")
    first, *others = value
    for second, third in combinations(others, 2):
        longest = max(math.dist(first, second), math.dist(second, third), math.dist(third, first))
        (x, y), (a, b), (c, d) = first, second, third
        if abs((a - x) * (d - y) - (c - x) * (b - y)) > _THINNEST_M * longest:
            return
    raise ValueError(f"the corners {list(value)} lie on a line, within {1e3 * _THINNEST_M:g} mm")


@documented
@attrs.frozen
class BaseOptions:
    """A base that drives: its footprint stays clear of the objects of the section `world`."""

    footprint: tuple[tuple[float, float], ...] = option(
        unit="m",
        validator=_corners,
        help="corners of its outline about its middle, x ahead and y to the left, with all that sticks out, e.g. an"
        " arm; their convex hull counts",
    )
    bottom: float = option(0.0, unit="m", ge=-10, le=10, help="height at which it begins, in the frame of the world")
    top: float = option(0.5, unit="m", ge=-10, le=10, help="height at which it ends")
    margin: float = option(0.05, unit="m", ge=LEAST_M, le=1, help="minimum distance from objects")
    x: str = option("x", help="joint that drives ahead; a base may lack one of the three")
    y: str = option("y", help="joint that drives to the left")
    theta: str = option("theta", help="joint that turns, counterclockwise")

    def __attrs_post_init__(self) -> None:
        if not self.top - self.bottom >= _THINNEST_M:
            raise ValueError(
                f"bottom ({self.bottom:g}) must be below top ({self.top:g}), by {1e3 * _THINNEST_M:g} mm at least"
            )


@documented
@attrs.frozen
class RegionOptions:
    """A box along the axes of the base frame; links may touch the objects and cells that lie in it as a whole."""

    lower: tuple[float, float, float] = option(unit="m", validator=near, help="its lowest x, y and z")
    upper: tuple[float, float, float] = option(unit="m", validator=near, help="its highest x, y and z")
    links: tuple[str, ...] | None = option(
        None, help="links that may touch what lies in it, without limit; none: those of the hands"
    )

    def __attrs_post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"lower {list(self.lower)} must be below upper {list(self.upper)} along x, y and z")


@documented
@attrs.frozen
class ClearanceGuardOptions(Options):
    """The guard `clearance`: stops in front of the arm itself and of the objects of the section `world`."""

    margin: float = option(0.003, unit="m", ge=LEAST_M, le=0.2, help="minimum distance of the arm from objects")
    self_margin: float = option(LEAST_M, unit="m", ge=LEAST_M, le=0.2, help="minimum distance between the arm's links")
    floor: float | None = option(
        None, unit="m", help="height of the table's top in the base frame; none: that of robot.description, if any"
    )
    may_touch: Mapping[str, tuple[str, ...]] | None = option(
        None,
        help="object, e.g. floor -> links and objects that may touch it, and press on it by `press`; none: the hands"
        " may touch the floor",
    )
    press: float = option(0.01, unit="m", ge=0, le=0.1, help="how deep a command may lie in what `may_touch` names")
    free: Mapping[str, tuple[str, ...]] | None = option(
        None,
        help="object -> links and objects that may touch it and press on it without limit: what is grasped; none: the"
        " hands may touch objects that are `movable`",
    )
    regions: Mapping[str, RegionOptions] = option(
        factory=dict, help="places in which objects may be touched, e.g. a tray from which the arm picks"
    )
    when_stale: Literal["hold", "keep"] = option(
        "hold",
        help="when a part of the world is too old, whose own rule is `refuse`: brake and hold, or keep what was seen",
    )
    base: BaseOptions | None = option(
        None, help="of a robot without a model, whose joints are the axes of a base, e.g. for cmd_vel: its footprint"
    )
    sound: bool = option(False, help="ring the terminal's bell, and sound on the page, when it begins to hold back")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has a model or a base, and the links that regions name."""
        if self.base is not None:
            yield from self._check_base(self.base, robot)
        elif robot.description.mjcf is None:
            what = "the guard needs robot.description.mjcf, or the footprint of a base: set one, or leave it out"
            yield OptionFault((), what, "mjcf")
        known = link_names(robot)
        for name, region in self.regions.items():
            for i, link in enumerate(region.links or ()):
                if known and link not in known:
                    message = f"unknown link {link!r}{did_you_mean(link, known, 'known')}"
                    yield OptionFault(("regions", name, "links", i), message)

    def _check_base(self, base: BaseOptions, robot: Robot) -> Iterable[OptionFault]:
        if robot.description.mjcf is not None:
            message = "is for robots without robot.description.mjcf: the model has to have the joints of its base"
            yield OptionFault(("base",), message)
        axes = {"x": base.x, "y": base.y, "theta": base.theta}
        if not set(axes.values()) & set(robot.joint_names):
            hint = did_you_mean(base.x, robot.joint_names, "the joints are")
            yield OptionFault(("base",), f"the robot has none of the joints {', '.join(axes.values())}{hint}")
        if len(set(axes.values())) < len(axes):
            yield OptionFault(("base",), f"x, y and theta must be three joints, got {', '.join(axes.values())}")
