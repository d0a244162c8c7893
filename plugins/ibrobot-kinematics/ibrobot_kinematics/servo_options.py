"""Options of a tool that follows twists. Nothing here imports NumPy."""

from __future__ import annotations

import attrs

from ibrobot_core.api import Options, documented, option
from ibrobot_kinematics.path_constraints import PathConstraints


@documented
@attrs.frozen
class ServoOptions(Options):
    """Limits of twists, and when the tool slows down and stops."""

    timeout: float = option(0.1, unit="s", gt=0, le=1, help="how long a twist is valid; then the tool slows to a stop")
    max_linear: float = option(1.0, unit="m/s", gt=0, help="faster twists are refused")
    max_angular: float = option(6.0, unit="rad/s", gt=0, help="twists that turn faster are refused")
    lower_singularity_threshold: float = option(
        30.0, gt=1, help="condition number of the Jacobian, at a lever of 0.1 m, from which the tool slows down"
    )
    hard_stop_singularity_threshold: float = option(100.0, gt=1, help="condition number at which it stops")
    joint_limit_margin: float = option(
        0.1, unit="rad", gt=0, help="distance from its limit within which a joint slows down from its full speed"
    )
    slow_distance: float = option(0.05, unit="m", gt=0, help="distance from an obstacle from which the tool slows down")
    stop_distance: float = option(0.01, unit="m", ge=0, help="distance from an obstacle at which it stops")
    path_constraints: PathConstraints | None = option(
        None, help="what holds while the tool moves, e.g. {upright: 0.17, upright_axis: -z}: near a bound it slows down"
    )

    def __attrs_post_init__(self) -> None:
        kept = self.path_constraints
        if kept is not None and kept.upright is not None and kept.upright_axis is None:
            # The axis nearest to the vertical would change with each start, e.g. after a person has tilted the tool.
            raise ValueError(
                "path_constraints: a device's upright needs upright_axis, the axis of the tool that points up: x, y, z,"
                " -x, -y, -z, or three numbers; -z for a tool that points down"
            )
        for low, high in (
            ("lower_singularity_threshold", "hard_stop_singularity_threshold"),
            ("stop_distance", "slow_distance"),
        ):
            below, above = attrs.asdict(self)[low], attrs.asdict(self)[high]
            if not below < above:
                raise ValueError(f"{low} is {below:g}, must be below {high}, which is {above:g}")
