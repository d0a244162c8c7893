"""What the YAML may say under a `type: replay` of teleoperation."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.options import documented, option


@documented
@attrs.frozen
class ReplayOptions:
    """Options of `type: replay`."""

    path: Path = option(help="the joint log: a CSV with the header time_s,JOINT,…")
    speed: float = option(1.0, gt=0, help="how many seconds of the log are played in a second")
    loop: bool = option(False, help="whether to begin again at the end")
    approach_speed: float = option(
        0.5, unit="rad/s", gt=0, help="greatest speed on the way to the log's first sample; max_velocity bounds it too"
    )
