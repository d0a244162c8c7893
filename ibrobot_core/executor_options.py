"""Options of executors that follow setpoints; apart from these so that listing plugins imports no control code."""

from __future__ import annotations

import attrs

from ibrobot_core.options import documented, option


@documented
@attrs.frozen
class StreamOptions:
    """Options of any executor that follows a stream of setpoints."""

    stale_timeout: float = option(0.25, unit="s", gt=0, help="age of the last setpoint at which it is stale")
    safety_behavior: str = option(
        "hold", choices=("hold", "relax"), help="what follows when it is stale; the contract's action may say it too"
    )


@documented
@attrs.frozen
class PositionOptions(StreamOptions):
    """Options of `type: position`."""
