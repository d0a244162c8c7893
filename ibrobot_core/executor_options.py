"""Options of executors that follow setpoints, in their own module so that listing plugins imports no control code."""

from __future__ import annotations

import attrs

from ibrobot_core.options import documented, option


@documented
@attrs.frozen
class StreamOptions:
    """Options of any executor that follows a stream of setpoints."""

    stale_timeout: float = option(0.25, unit="s", gt=0, help="age at which the last setpoint becomes stale")
    safety_behavior: str = option(
        "hold", choices=("hold", "relax"), help="behaviour for stale setpoints, here or in the contract's action"
    )
