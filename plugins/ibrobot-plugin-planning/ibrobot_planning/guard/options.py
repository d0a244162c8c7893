"""Options of the guard `clearance`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Literal

import attrs

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


@documented
@attrs.frozen
class ClearanceGuardOptions(Options):
    """The guard `clearance`: stops in front of the arm itself and of the objects of the section `world`."""

    margin: float = option(0.003, unit="m", ge=0, le=0.2, help="least distance of the arm from objects")
    self_margin: float = option(
        0.001, unit="m", ge=0, le=0.2, help="least distance of the arm's links from one another"
    )
    floor: float | None = option(
        None, unit="m", help="height of the table's top in the base frame; none: there is no table"
    )
    may_touch: Mapping[str, tuple[str, ...]] = option(
        factory=dict,
        help="object, e.g. floor -> links and objects that may touch it, and press on it by `press`",
    )
    press: float = option(0.01, unit="m", ge=0, le=0.1, help="how deep a command may lie in what `may_touch` names")
    free: Mapping[str, tuple[str, ...]] = option(
        factory=dict,
        help="object -> links and objects that may touch it and press on it without limit: what is grasped",
    )
    when_stale: Literal["hold", "keep"] = option(
        "hold",
        help="when a part of the world is too old, whose own rule is `refuse`: brake and hold, or keep what was seen",
    )

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the robot has a model."""
        if robot.description.mjcf is None:
            yield OptionFault((), "the guard needs robot.description.mjcf: set it, or leave control.guard out", "mjcf")
