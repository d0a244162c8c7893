"""The robot itself: joints in their order, limits, groups, poses and where its models are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.options import option

Vector = NDArray[np.float64]


@attrs.frozen
class Joint:
    """One joint; SI units."""

    name: str = option(help="as in the URDF and MJCF")
    lower: float = option(unit="rad", help="lower position limit")
    upper: float = option(unit="rad", help="upper position limit")
    max_velocity: float = option(unit="rad/s", gt=0, help="speed that no command exceeds")
    max_acceleration: float = option(unit="rad/s^2", gt=0, help="acceleration that no command exceeds")

    def __attrs_post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ValueError(f"lower ({self.lower}) must be below upper ({self.upper})")


@attrs.frozen
class Description:
    """Where the robot's models are, and its named poses."""

    mjcf: Path | None = option(None, help="MuJoCo model: a path, or package://PYTHON_PACKAGE/path")
    urdf: Path | None = option(None, help="URDF model: a path, or package://PYTHON_PACKAGE/path")
    tip: str = option("gripperframe", help="site (MJCF) or link (URDF) of the tool centre point")
    poses: Mapping[str, tuple[float, ...]] = option(factory=dict, unit="rad", help="joint positions in joint order")


@attrs.frozen(slots=False)
class Robot:
    """The `robot:` section. The order of `joints` is the order in every vector."""

    name: str = option(help="this robot's name")
    joints: tuple[Joint, ...] = option(help="the joints, in the order of every vector")
    robot_type: str = option("", help="as LeRobot names it, written into datasets")
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

    def indices(self, names: Sequence[str]) -> NDArray[np.intp]:
        """Positions of `names` in joint order, shape (len(names),).

        Raises:
            KeyError: for a name that is no joint of this robot.
        """
        order = {name: i for i, name in enumerate(self.joint_names)}
        missing = [n for n in names if n not in order]
        if missing:
            raise KeyError(f"no joint {missing[0]!r}; the joints are: {', '.join(self.joint_names)}")
        return np.array([order[n] for n in names], dtype=np.intp)

    def pose(self, name: str) -> Vector:
        """A named pose [rad], shape (J,).

        Raises:
            KeyError: for an unknown pose.
        """
        poses = self.description.poses
        if name not in poses:
            raise KeyError(f"no pose {name!r}; the poses are: {', '.join(poses) or 'none'}")
        return np.array(poses[name])
