"""Options of the guard `clearance`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Literal

import attrs

from ibrobot_core.api import OptionFault, Options, did_you_mean, documented, option
from ibrobot_planning.world.options import link_names, near

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


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

    margin: float = option(0.003, unit="m", ge=0, le=0.2, help="least distance of the arm from objects")
    self_margin: float = option(
        0.001, unit="m", ge=0, le=0.2, help="least distance of the arm's links from one another"
    )
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
    sound: bool = option(False, help="ring the terminal's bell, and sound on the page, when it begins to hold back")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has a model, and the links that regions name."""
        if robot.description.mjcf is None:
            yield OptionFault((), "the guard needs robot.description.mjcf: set it, or leave control.guard out", "mjcf")
        known = link_names(robot)
        for name, region in self.regions.items():
            for i, link in enumerate(region.links or ()):
                if known and link not in known:
                    message = f"unknown link {link!r}{did_you_mean(link, known, 'known')}"
                    yield OptionFault(("regions", name, "links", i), message)
