"""The robot: its joints in order, limits, groups, poses and models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import compress
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.options import documented, option

Vector = NDArray[np.float64]
"""Floats, e.g. one for each joint: shape (J,)."""

FARTHEST = 1e4
"""Largest position of a joint [rad, m]; larger values are mistakes, or would overflow."""
LAG_S = 0.1
"""How long after its setpoint a servo may be at a place [s]; ADR 0016 has what was measured."""
_LEAD_AT_REST = 0.2
"""How far a joint at rest may hang from its setpoint under load [rad]."""


@documented
@attrs.frozen
class Joint:
    """One joint; SI units."""

    name: str = option(help="name in the URDF and MJCF")
    lower: float = option(unit="rad", help="lower position limit")
    upper: float = option(unit="rad", help="upper position limit")
    max_velocity: float = option(unit="rad/s", gt=0, help="maximum speed of commands")
    max_acceleration: float = option(unit="rad/s^2", gt=0, help="maximum acceleration of commands")
    max_lead: float | None = option(
        None,
        unit="rad",
        gt=0,
        help="maximum distance of a command from the measured position; None: 0.2 rad, plus the distance in 0.1 s at "
        "max_velocity, plus the braking distance",
    )
    grips: bool | None = option(
        None,
        help="whether it grips objects, so that a distance from its setpoint is not a fault; None: true in a group "
        "named gripper",
    )
    beyond_model: bool = option(False, help="whether its limits may be wider than those of the URDF and MJCF")

    def __attrs_post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"lower ({self.lower}) must be below upper ({self.upper})")


@documented
@attrs.frozen
class Description:
    """The robot's models and named poses."""

    mjcf: Path | None = option(None, help="MuJoCo model: a path, or package://PYTHON_PACKAGE/path")
    urdf: Path | None = option(None, help="URDF model: a path, or package://PYTHON_PACKAGE/path")
    srdf: Path | None = option(None, help="SRDF with groups, poses and pairs of links that may touch: a path as above")
    tip: str = option("gripperframe", help="site (MJCF) or link (URDF) of the tool centre point")
    floor: float | None = option(
        None, unit="m", ge=-10, le=10, help="height of the table below the arm, in the base frame; none: unknown"
    )
    poses: Mapping[str, tuple[float, ...]] = option(factory=dict, unit="rad", help="joint positions in joint order")
    arms: Mapping[str, tuple[float, float, float, float]] = option(
        factory=dict,
        help="of several equal arms: prefix of its names, e.g. `left_`, with x, y, z [m] and yaw [rad] of its base",
    )

    def arm_of(self, joint: str) -> str:
        """The prefix of the arm of a joint; empty for a joint that is named as in the models."""
        return next((prefix for prefix in self.arms if joint.startswith(prefix)), "")


@documented
@attrs.frozen(slots=False)
class Robot:
    """The `robot:` section. The order of `joints` is the order in every vector."""

    name: str = option(help="name of the robot")
    joints: tuple[Joint, ...] = option(help="the joints, in the order of every vector")
    robot_type: str = option("", help="LeRobot's name of the robot type, for datasets")
    groups: Mapping[str, tuple[str, ...]] = option(factory=dict, help="named groups of joints; executors own them")
    description: Description = option(factory=Description, help="models and named poses")

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names in joint order."""
        return tuple(j.name for j in self.joints)

    @cached_property
    def lower(self) -> Vector:
        """Lower position limits [rad], shape (J,)."""
        return np.array([j.lower for j in self.joints])

    @cached_property
    def upper(self) -> Vector:
        """Upper position limits [rad], shape (J,)."""
        return np.array([j.upper for j in self.joints])

    @cached_property
    def max_velocity(self) -> Vector:
        """Velocity limits [rad/s], shape (J,)."""
        return np.array([j.max_velocity for j in self.joints])

    @cached_property
    def max_acceleration(self) -> Vector:
        """Acceleration limits [rad/s^2], shape (J,)."""
        return np.array([j.max_acceleration for j in self.joints])

    @cached_property
    def braking_s(self) -> Vector:
        """Time to brake from `max_velocity` [s], shape (J,)."""
        return self.max_velocity / self.max_acceleration

    @cached_property
    def max_lead(self) -> Vector:
        """Maximum distance of a command from the measured position [rad], shape (J,)."""
        velocity = self.max_velocity
        default = _LEAD_AT_REST + LAG_S * velocity + velocity**2 / (2 * self.max_acceleration)
        own = [np.nan if joint.max_lead is None else joint.max_lead for joint in self.joints]
        return np.where(np.isnan(own), default, own)

    @cached_property
    def grips(self) -> NDArray[np.bool_]:
        """Whether each joint grips objects, shape (J,)."""
        gripper = self.groups.get("gripper", ())
        return np.array([joint.name in gripper if joint.grips is None else joint.grips for joint in self.joints])

    def indices(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Indices of `names` in joint order, shape (len(names),).

        Raises:
            KeyError: if a name is not a joint of this robot.
        """
        order = {name: i for i, name in enumerate(self.joint_names)}
        missing = [n for n in names if n not in order]
        if missing:
            raise KeyError(f"no joint {missing[0]!r}; the joints are: {', '.join(self.joint_names)}")
        return np.array([order[n] for n in names], dtype=np.intp)

    def part(self, group: str) -> Robot:
        """The robot reduced to the joints of a group, in joint order, with the groups within it."""
        members = set(self.groups[group])
        kept = [joint.name in members for joint in self.joints]
        groups = {name: each for name, each in self.groups.items() if members.issuperset(each)}
        poses = {name: tuple(compress(pose, kept)) for name, pose in self.description.poses.items()}
        description = attrs.evolve(self.description, poses=poses)
        return attrs.evolve(self, joints=tuple(compress(self.joints, kept)), groups=groups, description=description)

    def pose(self, name: str) -> Vector:
        """A named pose [rad], shape (J,).

        Raises:
            KeyError: if the pose is unknown.
        """
        poses = self.description.poses
        if name not in poses:
            raise KeyError(f"no pose {name!r}; the poses are: {', '.join(poses) or 'none'}")
        return np.array(poses[name])
