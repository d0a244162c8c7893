"""The kinematic model of an arm: the chain of joints from the base to the tip, in numpy."""

from __future__ import annotations

from functools import cached_property

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import cross, skew


@attrs.frozen(eq=False)
class TipPose:
    """Pose of the tip in the base frame."""

    position: Vector
    """Origin of the tip [m], shape (3,)."""
    rotation: Vector
    """Axes of the tip as columns, shape (3, 3)."""


@attrs.frozen(eq=False)
class ChainJoint:
    """A joint between the base and the tip."""

    index: int
    """Index of the joint in `KinematicModel.joint_names`."""
    position: Vector
    """Origin of the joint in the frame of the previous joint, or of the base [m], shape (3,)."""
    rotation: Vector
    """Axes of the joint in that frame, as columns, at the reference position, shape (3, 3)."""
    axis: Vector
    """Unit vector along the joint's axis in its own frame, shape (3,)."""
    reference: float = 0.0
    """Reference position [rad or m], at which the joint causes no displacement."""
    slides: bool = False
    """Whether it is prismatic; revolute otherwise."""


@attrs.frozen(eq=False, slots=False)
class KinematicModel:
    """Kinematics of the tip of an arm.

    Vectors of joint positions have the order of `joint_names`; revolute joints are in rad, prismatic ones in m. The
    base frame is the world frame of the MJCF.
    """

    joint_names: tuple[str, ...]
    """All J joints. Joints that are not in `chain` do not move the tip."""
    lower: Vector
    """Lower position limits, shape (J,)."""
    upper: Vector
    """Upper position limits, shape (J,)."""
    chain: tuple[ChainJoint, ...]
    """The joints that move the tip, from the base outwards."""
    tip: str
    """Name of the tip's frame."""
    tip_pose: TipPose
    """The tip in the frame of the last joint of the chain."""

    def forward(self, q: Vector) -> TipPose:
        """Pose of the tip in the base frame.

        Args:
            q: joint positions, shape (…, J): one or many configurations.

        Returns:
            Position and rotation of shapes (…, 3) and (…, 3, 3).
        """
        return self.screws(q)[0]

    def jacobian(self, q: Vector) -> Vector:
        """Jacobian of the tip.

        Args:
            q: joint positions, shape (…, J).

        Returns:
            Array of shape (…, 6, J), in the base frame. Rows 0-2 have the velocity of the tip's origin [m/s], rows 3-5
            the angular velocity of the tip [rad/s], for each joint at unit speed.
        """
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Vector) -> tuple[TipPose, Vector]:
        """`forward(q)` and `jacobian(q)`, in little more time than one of them."""
        tip, linear, angular = self.twists(q)
        jacobian = np.zeros((*q.shape[:-1], 6, len(self.joint_names)))
        jacobian[..., :3, self.moving] = linear.swapaxes(-1, -2)
        jacobian[..., 3:, self.moving] = angular.swapaxes(-1, -2)
        return tip, jacobian

    def twists(self, q: Vector) -> tuple[TipPose, Vector, Vector]:
        """Pose of the tip, and its velocities for each of the chain's joints at unit speed.

        Args:
            q: joint positions, shape (…, J).

        Returns:
            The tip, the linear [m/s] and the angular velocities [rad/s], both shape (…, n, 3), all in the base frame.
        """
        tip, origins, axes = self.screws(q)
        linear = cross(axes, tip.position[..., None, :] - origins)
        if not self._slides.any():
            return tip, linear, axes
        slides = self._slides[:, None]
        return tip, np.where(slides, axes, linear), np.where(slides, 0.0, axes)

    @cached_property
    def moving(self) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Indices of the joints of `chain`, from the base outwards."""
        return np.array([joint.index for joint in self.chain], dtype=np.intp)

    @cached_property
    def reach(self) -> float:
        """Upper bound of the distance of the tip from the origin of the base frame [m]."""
        lengths = sum(float(np.linalg.norm(joint.position)) for joint in self.chain)
        ways = sum(
            max(abs(self.lower[joint.index] - joint.reference), abs(self.upper[joint.index] - joint.reference))
            for joint in self.chain
            if joint.slides
        )
        return lengths + float(np.linalg.norm(self.tip_pose.position)) + float(ways)

    @cached_property
    def _slides(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        return np.array([joint.slides for joint in self.chain], dtype=bool)

    @cached_property
    def _reference(self) -> Vector:
        return np.array([joint.reference for joint in self.chain])

    @cached_property
    def _terms(self) -> Vector:
        """Frame of each joint in its predecessor's as A + sin(q) B + (1 - cos(q)) C + q D, shape (4, n, 4, 4).

        B and C are 0 for prismatic joints, D for revolute ones.
        """
        terms = np.zeros((4, len(self.chain), 4, 4))
        for i, joint in enumerate(self.chain):
            terms[0, i] = homogeneous(joint.rotation, joint.position)
            k = skew(joint.axis)
            if joint.slides:
                terms[3, i, :3, 3] = joint.rotation @ joint.axis
            else:
                terms[1, i, :3, :3], terms[2, i, :3, :3] = joint.rotation @ k, joint.rotation @ k @ k
        return terms

    @cached_property
    def _axes(self) -> Vector:
        """Axes of the chain's joints in their own frames, as columns, shape (n, 3, 1)."""
        return np.array([joint.axis for joint in self.chain]).reshape(-1, 3, 1)

    @cached_property
    def _tip(self) -> Vector:
        """The tip in the frame of the last joint of the chain, shape (4, 4)."""
        return homogeneous(self.tip_pose.rotation, self.tip_pose.position)

    def screws(self, q: Vector) -> tuple[TipPose, Vector, Vector]:
        """Pose of the tip, and a point on the axis [m] and the direction of each of the chain's joints.

        Args:
            q: joint positions, shape (…, J).

        Returns:
            The tip, the points and the directions, both shape (…, n, 3), all in the base frame.
        """
        way = (q.take(self.moving, axis=-1) - self._reference)[..., None, None]
        still, turning, turned, moved = self._terms
        steps = still + np.sin(way) * turning + (1 - np.cos(way)) * turned
        if self._slides.any():
            steps += way * moved
        frames = np.empty_like(steps)
        frame = np.empty((*q.shape[:-1], 4, 4))
        frame[:] = np.eye(4)
        for i in range(len(self.chain)):
            frames[..., i, :, :] = frame = frame @ steps[..., i, :, :]
        tip = frame @ self._tip
        axes = (frames[..., :3, :3] @ self._axes)[..., 0]
        return TipPose(tip[..., :3, 3], tip[..., :3, :3]), frames[..., :3, 3], axes
