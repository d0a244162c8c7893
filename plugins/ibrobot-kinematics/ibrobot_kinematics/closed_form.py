"""Closed-form inverse kinematics of an arm with a pan joint, three parallel joints and a roll about the tool.

The parallel joints move the tip in a plane, which the pan rotates. Points in that plane are complex numbers: the real
part points away from the pan's axis, the imaginary part along it.
"""

from __future__ import annotations

from functools import lru_cache

import attrs
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_kinematics.model import KinematicModel
from ibrobot_kinematics.rotations import cross

_PARALLEL = 1e-4
"""Sine of the angle up to which axes count as parallel; a final step with the exact model corrects the difference."""
_NO_LENGTH = 1e-9
_NEARLY_VERTICAL = 0.02
"""If the horizontal part of a direction is smaller, it hardly determines the pan, which is then sampled."""
_PANS = 36
_TURN = 2 * np.pi

type Complex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]


@attrs.frozen(eq=False)
class Candidates:
    """Configurations within the limits, and how well they meet a target."""

    joints: Vector
    """Joint positions [rad] of the chain, from the base outwards, shape (N, 5)."""
    off: Vector
    """Distance of the tip from the target [m], shape (N,)."""
    turned: Vector
    """Angle between the tool and the target direction [rad], shape (N,); 0 for a target without one."""
    branch: np.ndarray[tuple[int], np.dtype[np.intp]]
    """Number of the branch, shape (N,)."""


@attrs.frozen(eq=False)
class PanPlanarRoll:
    """Geometry of such an arm, from its screw axes at the reference position."""

    frame: Vector
    """Rows: away from the pan's axis, along the parallel axes, along the pan's axis; shape (3, 3)."""
    origin: Vector
    """A point on the pan's axis [m], shape (3,)."""
    signs: Vector
    """Sign of each joint's rotation, shape (5,)."""
    reference: Vector
    lower: Vector
    upper: Vector
    shoulder: complex
    """First parallel axis [m]."""
    links: tuple[complex, complex]
    """From the first parallel axis to the second, and from there to the third [m]."""
    tool: complex
    """From the third parallel axis to the foot of the tip on the roll's axis [m]."""
    roll: complex
    """Direction of the roll's axis."""
    offset: complex
    """Tip seen from its foot [m]: along the parallel axes, and in the plane across the roll's axis."""
    lateral: float
    """Roll's axis along the parallel axes, seen from the pan's axis [m]."""
    points: float
    """1 if the tip's z axis is parallel to the roll's axis, -1 if antiparallel, otherwise 0."""

    def with_axis(self, position: Vector, axis: Vector, start: Vector) -> Candidates:
        """Up to eight branches: two of the pan, two of the roll, two of the elbow.

        For a vertical axis every pan is possible, so the pan is sampled.

        Args:
            position: target position of the tip in the base frame [m], shape (3,).
            axis: target direction of the tip's z axis, shape (3,).
            start: joint positions of the chain [rad]; solutions near them are preferred, shape (5,).
        """
        x, y, _ = self.frame @ (position - self.origin)
        ax, ay, az = self.points * (self.frame @ axis)
        heading = np.arctan2(ay, ax)
        pan = np.array([heading, heading, heading + np.pi, heading + np.pi])
        roll = self._rolls_at(x, y, pan, np.array([1, -1, 1, -1]), start)
        branch = np.arange(4)
        if np.hypot(ax, ay) < _NEARLY_VERTICAL:
            rolls = self._rolls(start, 24)
            pans = self._pans(x, y, rolls)
            pan, roll = np.concatenate([pan, *pans]), np.concatenate([roll, rolls, rolls])
            branch = np.concatenate([branch, np.repeat([4, 5], len(rolls))])
        tool = ax * np.cos(pan) + ay * np.sin(pan) + 1j * az
        return self._solved(position, axis, start, pan, np.angle(self.roll / tool), roll, branch)

    def at(self, position: Vector, axis: Vector | None, start: Vector, *, pitches: int, rolls: int) -> Candidates:
        """Four branches, two of the pan and two of the elbow; the free pitch and roll are sampled.

        Near the pan's axis there are four more, in which the pan is sampled in place of the roll.

        The first sample is that of `start`. The arguments are as in `with_axis`; an axis only affects `turned`.
        """
        x, y, _ = self.frame @ (position - self.origin)
        at_start = self._turned(start)
        roll = self._rolls(start, rolls)
        pitch = at_start[1:4].sum() + np.arange(pitches) * (_TURN / pitches)
        pan, roll = np.concatenate(self._pans(x, y, roll)), np.tile(roll, 2)
        branch = np.repeat([0, 1], rolls)
        if np.hypot(x, y) < 2 * abs(self.offset) + abs(self.lateral):
            # This near the pan's axis, all pans are possible, within a small range of rolls.
            around, side = np.tile(np.arange(_PANS) * (_TURN / _PANS), 2), np.repeat([1, -1], _PANS)
            pan, roll = np.append(pan, around), np.append(roll, self._rolls_at(x, y, around, side, start))
            branch = np.append(branch, np.repeat([2, 3], _PANS))
        pan, roll, branch = (np.repeat(each, pitches) for each in (pan, roll, branch))
        return self._solved(position, axis, start, pan, np.tile(pitch, len(pan) // pitches), roll, branch)

    def _turned(self, joints: Vector) -> Vector:
        """Rotation of the joints from the reference position, about the axes of the frame."""
        return np.asarray((joints - self.reference) * self.signs)

    def _rolls(self, start: Vector, number: int) -> Vector:
        """Samples of the roll within its limits, that of `start` first."""
        among = np.linspace(self.lower[4], self.upper[4], number - 1)
        return np.asarray((np.append(start[4], among) - self.reference[4]) * self.signs[4])

    def _rolls_at(self, x: float, y: float, pan: Vector, side: Vector, start: Vector) -> Vector:
        """The roll on each side with which the arm's plane, at each pan, contains the target."""
        reach = abs(self.offset)
        if reach < _NO_LENGTH:
            return np.full(len(pan), self._turned(start)[4])
        cosine = (np.cos(pan) * y - np.sin(pan) * x - self.lateral) / reach
        return np.asarray(np.arccos(np.clip(cosine, -1, 1)) * side - np.angle(self.offset))

    def _pans(self, x: float, y: float, roll: Vector) -> tuple[Vector, Vector]:
        """Both pan angles at which the arm's plane, with this roll, contains the target."""
        lateral = self.lateral + (self.offset * np.exp(1j * roll)).real
        ahead = np.sqrt(np.maximum(x * x + y * y - lateral * lateral, 0.0))
        heading = np.arctan2(y, x)
        return heading - np.arctan2(lateral, ahead), heading - np.arctan2(lateral, -ahead)

    def _solved(
        self, position: Vector, axis: Vector | None, start: Vector, pan: Vector, pitch: Vector, roll: Vector,
        branch: np.ndarray[tuple[int], np.dtype[np.intp]],
    ) -> Candidates:  # fmt: skip
        """Both elbows for each pan, pitch (sum of the parallel joints) and roll, within the limits."""
        x, y, z = self.frame @ (position - self.origin)
        near, far = self.links
        in_plane = np.cos(pan) * x + np.sin(pan) * y + 1j * z
        wrist = in_plane - self.shoulder - np.exp(-1j * pitch) * self._reach(roll)
        cosine = (wrist.real**2 + wrist.imag**2 - abs(near) ** 2 - abs(far) ** 2) / (2 * abs(near) * abs(far))
        bend = np.arccos(np.clip(cosine, -1, 1))
        elbow = np.angle(far / near) + np.concatenate([bend, -bend])
        pan, pitch, roll, wrist = (np.concatenate([each, each]) for each in (pan, pitch, roll, wrist))
        # If the wrist is on the shoulder, the lift is free, and angle(0) is a valid choice.
        lift = np.angle((near + np.exp(-1j * elbow) * far) * np.conj(wrist))
        joints = self.reference + self.signs * np.stack([pan, lift, elbow, pitch - lift - elbow, roll], axis=1)
        joints = self._within(joints, start)
        off, turned = self._missed(joints, position, axis)
        return Candidates(joints, off, turned, np.concatenate([2 * branch, 2 * branch + 1]))

    def _within(self, joints: Vector, start: Vector) -> Vector:
        """Equivalent angles near `start` if the limits permit, otherwise the nearest ones within them."""
        by_start = joints - _TURN * np.round((joints - start) / _TURN)
        middle = (self.lower + self.upper) / 2
        by_middle = joints - _TURN * np.round((joints - middle) / _TURN)
        inside = (self.lower <= by_start) & (by_start <= self.upper)
        return np.clip(np.where(inside, by_start, by_middle), self.lower, self.upper)

    def _reach(self, roll: Vector) -> Complex:
        """Vector from the third parallel axis to the tip at a pitch of zero [m]."""
        return np.asarray(self.tool + 1j * self.roll * (self.offset * np.exp(1j * roll)).imag)

    def _missed(self, joints: Vector, position: Vector, axis: Vector | None) -> tuple[Vector, Vector]:
        """Distances [m] from the position and angles [rad] from the axis."""
        turned = self._turned(joints)
        x, y, z = self.frame @ (position - self.origin)
        pan, lift, roll = turned[:, 0], turned[:, 1], turned[:, 4]
        forearm, pitch = lift + turned[:, 2], turned[:, 1:4].sum(axis=1)
        near, far = self.links
        tip = self.shoulder + np.exp(-1j * lift) * near + np.exp(-1j * forearm) * far
        tip += np.exp(-1j * pitch) * self._reach(roll)
        # The target in the rotated plane.
        target = (x + 1j * y) * np.exp(-1j * pan)
        aside = target.imag - self.lateral - (self.offset * np.exp(1j * roll)).real
        off = np.sqrt((target.real - tip.real) ** 2 + aside**2 + (z - tip.imag) ** 2)
        if axis is None:
            return off, np.zeros(len(off))
        ax, ay, az = self.points * (self.frame @ axis)
        requested = (ax + 1j * ay) * np.exp(-1j * pan)
        tool = self.roll * np.exp(-1j * pitch)
        chord = np.sqrt((requested.real - tool.real) ** 2 + requested.imag**2 + (az - tool.imag) ** 2)
        return off, 2 * np.arcsin(np.minimum(chord / 2, 1.0))


@lru_cache(maxsize=16)
def closed_form(model: KinematicModel) -> PanPlanarRoll | None:
    """The geometry of an arm that has a closed form, from its screw axes; None for any other arm."""
    if len(model.chain) != 5 or any(joint.slides for joint in model.chain):
        return None
    at_reference = np.zeros(len(model.joint_names))
    reference = np.array([joint.reference for joint in model.chain])
    at_reference[model.moving] = reference
    tip, points, axes = model.screws(at_reference)
    pan, parallel, roll = axes[0], axes[1], axes[4]
    if any(np.linalg.norm(cross(parallel, other)) > _PARALLEL for other in axes[2:4]):
        return None
    if abs(parallel @ pan) > _PARALLEL or abs(parallel @ roll) > _PARALLEL:
        return None
    frame = np.array([cross(parallel, pan), parallel, pan])
    x, y, z = (points - points[0]) @ frame.T[:, 0], (points - points[0]) @ parallel, (points - points[0]) @ pan
    shoulder, elbow, wrist, on_roll = (complex(x[i], z[i]) for i in range(1, 5))
    if min(abs(elbow - shoulder), abs(wrist - elbow)) < _NO_LENGTH:
        return None
    direction = complex(frame[0] @ roll, pan @ roll)
    along = float((tip.position - points[4]) @ roll)
    away = tip.position - points[4] - along * roll
    across = cross(roll, parallel)
    pointing = float(tip.rotation[:, 2] @ roll)
    return PanPlanarRoll(
        frame=frame,
        origin=points[0],
        signs=np.array([1.0, *np.sign(axes[1:4] @ parallel), 1.0]),
        reference=reference,
        lower=model.lower[model.moving],
        upper=model.upper[model.moving],
        shoulder=shoulder,
        links=(elbow - shoulder, wrist - elbow),
        tool=on_roll - wrist + along * direction,
        roll=direction,
        offset=complex(away @ parallel, away @ across),
        lateral=float(y[4]),
        points=float(np.sign(pointing)) if np.linalg.norm(cross(tip.rotation[:, 2], roll)) < _PARALLEL else 0.0,
    )
