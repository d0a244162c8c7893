"""Options of devices that a hand moves and the robot follows; imports nothing heavy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import attrs

from ibrobot_core.api import Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


@documented
@attrs.frozen(kw_only=True)
class HandMovedOptions(Options):
    """How the robot approaches and follows a device that a hand moves."""

    ramp_velocity: float = option(
        1.0,
        unit="rad/s",
        gt=0,
        help="velocity at which the robot approaches the device's pose, at first and after each pause",
    )
    follow_tolerance: float = option(
        0.02, unit="rad", gt=0, help="distance from the device's pose at which the approach ends"
    )
    deadman: str = option(
        "toggle",
        choices=("toggle", "hold", "none"),
        help="toggle: a key starts and pauses; hold: follows while it is held; none: follows once the device is moved, "
        "for runs without a terminal",
    )
    release: float = option(
        0.2, unit="s", gt=0, le=1, help="deadman hold: a key that is not repeated for this long counts as released"
    )
    deadman_key: str = option("space", help="key of the deadman; two devices may have the same or different ones")

    def terminal_keys(self, robot: Robot) -> Mapping[str, str]:
        """The deadman, unless it is none."""
        return {} if self.deadman == "none" else {self.deadman_key: "deadman"}
