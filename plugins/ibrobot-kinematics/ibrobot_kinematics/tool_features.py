"""Features `tool.PART`: position and orientation of the tool in the base frame of its arm, and the gripper's position.

| part | names | |
|---|---|---|
| `position` | `ee.x`, `ee.y`, `ee.z` | [m] |
| `rotation_6d` | `ee.r11`, `ee.r21`, `ee.r31`, `ee.r12`, `ee.r22`, `ee.r32` | its x and y axis (Zhou et al. 2019) |
| `rotation_vector` | `ee.wx`, `ee.wy`, `ee.wz` | axis times angle [rad] |
| `quaternion` | `ee.qx`, `ee.qy`, `ee.qz`, `ee.qw` | w is not negative |
| `delta_position` | `ee.delta_x`, … | from the measured position to the commanded one, in the base frame [m] |
| `delta_rotation_vector` | `ee.delta_wx`, … | the turn between them, about an axis in the base frame [rad] |
| `gripper` | `ee.gripper_pos` | position of the joint that grips, in the units of joints |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import ContractError, Robot, Vector, did_you_mean
from ibrobot_core.app import JointFeature
from ibrobot_kinematics.delta_features import Positions
from ibrobot_kinematics.feature import ActionFeature
from ibrobot_kinematics.follow import follow
from ibrobot_kinematics.model import KinematicModel, TipPose
from ibrobot_kinematics.model_values import arm_values, model_of
from ibrobot_kinematics.rotations import exp, from_quaternion, log, quaternion
from ibrobot_kinematics.target import Target

POSITION_TOLERANCE_M = 0.005
"""A pose whose position the arm misses by more counts as unreachable: half the width of a finger."""
ROTATION_TOLERANCE_RAD = 0.35
"""As above, for the orientation: an arm with five joints meets few exactly, and those of a policy are estimates."""
_NO_LENGTH = 1e-6
"""Directions of a 6D rotation that are shorter, or whose sine is smaller, determine no rotation."""

PREFIX = "tool."
GRIPPER = "gripper"
_XYZ = ("x", "y", "z")
_NAMES: Mapping[str, tuple[str, ...]] = {
    "position": _XYZ,
    "rotation_6d": ("r11", "r21", "r31", "r12", "r22", "r32"),
    "rotation_vector": ("wx", "wy", "wz"),
    "quaternion": ("qx", "qy", "qz", "qw"),
    "delta_position": tuple(f"delta_{each}" for each in _XYZ),
    "delta_rotation_vector": tuple(f"delta_w{each}" for each in _XYZ),
    GRIPPER: ("gripper_pos",),
}
"""Part -> names of its numbers."""
_POSITIONS = ("position", "delta_position")


def rotation_6d(rotation: Vector) -> Vector:
    """The first two columns of rotation matrices, shape (…, 3, 3), one after the other, shape (…, 6)."""
    return np.concatenate([rotation[..., :, 0], rotation[..., :, 1]], axis=-1)


def from_rotation_6d(numbers: Vector) -> Vector:
    """The matrix, shape (3, 3), by Gram-Schmidt: its x axis has the direction of the first three.

    Raises:
        ValueError: if the directions are zero or parallel.
    """
    first, second = numbers[:3], numbers[3:]
    if (length := float(np.linalg.norm(first))) < _NO_LENGTH:
        raise ValueError(f"a 6D rotation without its first direction: {numbers.tolist()}")
    x = first / length
    across = second - (x @ second) * x
    if (rest := float(np.linalg.norm(across))) <= _NO_LENGTH * float(np.linalg.norm(second)):
        raise ValueError(f"a 6D rotation whose two directions are parallel, or without the second: {numbers.tolist()}")
    y = across / rest
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _from_quaternion(numbers: Vector) -> Vector:
    if not _NO_LENGTH <= (length := math.hypot(*numbers.tolist())) < math.inf:
        raise ValueError(f"a quaternion without a length: {numbers.tolist()}")
    return from_quaternion(numbers / length)


_ROTATIONS: Mapping[str, tuple[Callable[[Vector], Vector], Callable[[Vector], Vector]]] = {
    "rotation_6d": (rotation_6d, from_rotation_6d),
    "rotation_vector": (log, exp),
    "quaternion": (quaternion, _from_quaternion),
}
"""Part -> a matrix as its numbers, and numbers as the matrix."""


def split(path: str, arms: Sequence[str]) -> tuple[str, str]:
    """The prefix of the arm and the part that a path names.

    Args:
        path: `tool.PART`, or of a robot with several arms `tool.ARM.PART`.
        arms: prefixes of the arms, with or without `_` at their end; that of a robot with one arm is empty.

    Raises:
        ContractError: if it names none of these.
    """
    *rest, part = path.removeprefix(PREFIX).split(".")
    if part not in _NAMES:
        raise ContractError(f"{path!r}: the tool has no {part!r}{did_you_mean(part, list(_NAMES), 'its parts are')}")
    own = {arm.rstrip("_"): arm for arm in arms}
    if (name := ".".join(rest)) not in own or rest == [""]:
        if not rest:
            example = f"{PREFIX}{next(iter(own), 'ARM')}.{part}"
            raise ContractError(f"{path!r}: the robot has several tools; name the arm, e.g. {example}")
        known = f": {', '.join(own)}" if any(own) else f"; it has one tool: {PREFIX}{part}"
        raise ContractError(f"{path!r}: the robot has no arm {name!r}{known}")
    return own[name], part


def tool_model(robot: Robot, paths: Sequence[str]) -> dict[str, Any]:
    """The chains of the arms that paths name, and the joints that grip.

    Raises:
        ContractError: for a path that names no part of a tool, or a robot without a model.
    """
    arms = tuple(robot.description.arms) or ("",)
    named = [split(path, arms) for path in paths]
    model: dict[str, Any] = {"arms": list(arms)}
    for arm in dict.fromkeys(arm for arm, part in named if part != GRIPPER):
        model.setdefault("chains", {})[arm] = arm_values(robot, arm)
    for arm in dict.fromkeys(arm for arm, part in named if part == GRIPPER):
        model.setdefault("grippers", {})[arm] = _gripper(robot, arm)
    return model


def _gripper(robot: Robot, arm: str) -> str:
    joints = zip(robot.joint_names, robot.grips, strict=True)
    own = [name for name, grips in joints if grips and robot.description.arm_of(name) == arm]
    if len(own) != 1:
        has = ", ".join(own) or "none"
        raise ContractError(f"{PREFIX}{GRIPPER} is the position of the one joint that grips, the robot has: {has}")
    return own[0]


def tool_feature(model: Mapping[str, Any], paths: Sequence[str], joints: Sequence[str]) -> JointFeature:
    """The numbers that paths `tool.PART` name, one after the other.

    Raises:
        ContractError: for paths that name no part of a tool, or do not fit an observation or an action.
    """
    with _recorded(paths):
        named = [split(path, model["arms"]) for path in paths]
        names = tuple(f"{arm}ee.{name}" for arm, part in named for name in _NAMES[part])
        if joints:
            action_features(model, paths, joints)
            return JointFeature(tuple(joints), names)
        (arm, part), *others = named
        if others:
            raise ContractError(f"one path at a time, got {', '.join(paths)}")
        if part == GRIPPER:
            return JointFeature((model["grippers"][arm],), names)
        if part.startswith("delta_"):
            raise ContractError(f"{paths[0]!r}: only an action is relative to the measured pose")
        chain = model_of(model["chains"][arm])
    return JointFeature(chain.joint_names, names, lambda q: _absolute(chain.forward(q), part))


def _absolute(tip: TipPose, part: str) -> Vector:
    return tip.position if part == "position" else _ROTATIONS[part][0](tip.rotation)


@attrs.frozen(eq=False)
class Piece:
    """A part of an action's numbers, and the joints whose positions they determine."""

    feature: ActionFeature
    joints: tuple[str, ...]
    first: int
    """Index of its first number among those of the action."""


def action_features(
    model: Mapping[str, Any],
    paths: Sequence[str],
    joints: Sequence[str],
    limits: Mapping[str, tuple[float, float]] | None = None,
) -> list[Piece]:
    """The numbers of an action that paths `tool.PART` name.

    Args:
        model: as `tool_model` returns it.
        paths: the paths.
        joints: the joints that the action moves.
        limits: joint -> lower and upper limit [rad or m], for `decode`; None without limits.

    Raises:
        ContractError: if they do not determine positions of these joints.
    """
    with _recorded(paths):
        return _pieces(model, [split(path, model["arms"]) for path in paths], paths, joints, limits)


@contextmanager
def _recorded(paths: Sequence[str]) -> Iterator[None]:
    """Makes what a damaged model raises an error of the contract."""
    try:
        yield
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ContractError(f"{paths[0]!r}: not a recorded model of tools: {error!r}") from None


def _pieces(
    model: Mapping[str, Any],
    named: Sequence[tuple[str, str]],
    paths: Sequence[str],
    joints: Sequence[str],
    limits: Mapping[str, tuple[float, float]] | None,
) -> list[Piece]:
    arm, parts = named[0][0], tuple(part for _, part in named if part != GRIPPER)
    if any(each != arm for each, _ in named):
        raise ContractError(f"an executor moves one tool, got {', '.join(paths)}")
    grippers = (model["grippers"][arm],) if len(named) > len(parts) else ()
    if len(named) > len(parts) + 1:
        raise ContractError(f"the gripper is there twice, got {', '.join(paths)}")
    chain = model_of(model["chains"][arm], limits) if parts else None
    needed = (*(chain.joint_names if chain is not None else ()), *grippers)
    if sorted(joints) != sorted(needed):
        raise ContractError(
            f"{', '.join(paths)}: determine the joints {', '.join(needed)}; the executor has: {', '.join(joints)}"
        )
    pieces: list[Piece] = []
    at_gripper = [part for _, part in named].index(GRIPPER) if grippers else None
    if at_gripper not in (None, 0, len(parts)):
        raise ContractError(f"the gripper comes before or after the pose, got {', '.join(paths)}")
    names = tuple(f"{arm}ee.{name}" for part in parts for name in _NAMES[part])
    if grippers:
        position = Positions([f"{arm}ee.{_NAMES[GRIPPER][0]}"])
        pieces.append(Piece(position, grippers, 0 if at_gripper == 0 else len(names)))
    if chain is not None:
        _check_pose(parts, paths)
        pieces.append(Piece(ToolPoses(chain, parts, names), chain.joint_names, 1 if at_gripper == 0 else 0))
    return pieces


def _check_pose(parts: Sequence[str], paths: Sequence[str]) -> None:
    where, turns = [each for each in parts if each in _POSITIONS], [each for each in parts if each not in _POSITIONS]
    if len(where) != 1 or len(turns) > 1:
        raise ContractError(
            f"an action needs one position and at most one orientation of the tool, got {', '.join(paths)}"
        )
    if turns and where[0].startswith("delta_") != turns[0].startswith("delta_"):
        raise ContractError(f"position and orientation are both relative, or both are not, got {', '.join(paths)}")


class ToolPoses(ActionFeature):
    """Poses of the tool in place of the positions of its arm's joints.

    A pose becomes positions by a search within the limits that begins at those before it, so that the arm never changes
    its branch. Its work is bounded, and equal arguments give equal positions.
    """

    def __init__(self, chain: KinematicModel, parts: tuple[str, ...], names: tuple[str, ...]) -> None:
        self.names = names
        self._chain, self._parts = chain, parts
        self._relative = parts[0].startswith("delta_")
        self.reference = chain.joint_names if self._relative else ()
        ends = np.cumsum([0, *(len(_NAMES[part]) for part in parts)])
        self._slices = {part: slice(*ends[i : i + 2]) for i, part in enumerate(parts)}

    @override
    def encode(self, positions: Vector, measured: Vector) -> Vector:
        tip = self._chain.forward(measured) if self._relative else None
        rows = positions.reshape(-1, positions.shape[-1])
        numbers = np.array([self._numbers(self._chain.forward(row), tip) for row in rows])
        return numbers.reshape(*positions.shape[:-1], len(self.names))

    def _numbers(self, tip: TipPose, measured: TipPose | None) -> Vector:
        if measured is None:
            return np.concatenate([_absolute(tip, part) for part in self._parts])
        numbers = {
            "delta_position": tip.position - measured.position,
            "delta_rotation_vector": log(tip.rotation @ measured.rotation.T),
        }
        return np.concatenate([numbers[part] for part in self._parts])

    @override
    def decode(self, numbers: Vector, measured: Vector, start: Vector) -> tuple[Vector, int]:
        tip = self._chain.forward(measured) if self._relative else None
        positions, held = np.empty((len(numbers), len(start))), 0
        before = np.clip(start, self._chain.lower, self._chain.upper)
        for row, each in enumerate(numbers):
            reached = self._reached(each, tip, before)
            if reached is None:
                held += 1
                positions[row] = positions[row - 1] if row else start
            else:
                positions[row] = before = reached
        return positions, held

    def _reached(self, numbers: Vector, measured: TipPose | None, before: Vector) -> Vector | None:
        """The positions of the chain for a pose; None if none within the limits is near enough."""
        try:
            target = self._target(numbers, measured)
        except ValueError:
            return None
        if np.abs(target.position).max() > 2 * self._chain.reach:
            return None
        nearest = follow(self._chain, target, before)
        if nearest is None:
            return None
        off, turned = target.missed(self._chain.forward(nearest))
        return nearest if off <= POSITION_TOLERANCE_M and turned <= ROTATION_TOLERANCE_RAD else None

    def _target(self, numbers: Vector, measured: TipPose | None) -> Target:
        given = {part: numbers[each] for part, each in self._slices.items()}
        if measured is not None:
            turn = given.get("delta_rotation_vector")
            rotation = None if turn is None else exp(turn) @ measured.rotation
            return Target(measured.position + given["delta_position"], rotation)
        rotations = [_ROTATIONS[part][1](each) for part, each in given.items() if part in _ROTATIONS]
        return Target(given["position"], *rotations)
