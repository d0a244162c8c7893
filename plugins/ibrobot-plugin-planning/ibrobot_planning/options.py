"""What the YAML may say under `planner: {type: joint}`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import documented, option


@documented
@attrs.frozen
class JointPlannerOptions:
    """Options of `type: joint`."""

    velocity_scaling: float = option(1.0, gt=0, le=1, help="fraction of the velocity limits that a request's 1.0 means")
    acceleration_scaling: float = option(
        1.0, gt=0, le=1, help="fraction of the acceleration limits that a request's 1.0 means"
    )
    max_jerk: float = option(200.0, unit="rad/s^3", gt=0, help="jerk that no joint exceeds")
    step: float = option(0.02, unit="s", ge=0.001, help="greatest time between points of the trajectory")
