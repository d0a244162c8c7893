"""Kinematic models as plain values, for contracts: the same numbers wherever a recording is read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ibrobot_core.api import ContractError, Robot
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.mjcf import robot_model
from ibrobot_kinematics.model import ChainJoint, KinematicModel, TipPose

_DECIMALS = 9
"""Nanometres: releases of MuJoCo may differ in the last bits, and contracts are compared by their text."""


def arm_values(robot: Robot, arm: str) -> Mapping[str, Any]:
    """The chain of joints from the base of an arm to its tool.

    Args:
        robot: the robot.
        arm: prefix of the arm's names, of `robot.description.arms`; empty for a robot with one arm.

    Raises:
        ContractError: if the robot has no usable model.
    """
    names = tuple(name for name in robot.joint_names if robot.description.arm_of(name) == arm)
    try:
        model = robot_model(robot, names)
    except KinematicsError as error:
        raise ContractError(f"the pose of the tool is unknown: {error}") from None
    return {
        "joints": [
            {
                "name": names[joint.index],
                "position": _rounded(joint.position),
                "rotation": _rounded(joint.rotation.ravel()),
                "axis": _rounded(joint.axis),
                "reference": _rounded([joint.reference])[0],
                "slides": joint.slides,
            }
            for joint in model.chain
        ],
        "tip": {
            "name": model.tip,
            "position": _rounded(model.tip_pose.position),
            "rotation": _rounded(model.tip_pose.rotation.ravel()),
        },
    }


def _rounded(numbers: ArrayLike) -> list[float]:
    rounded: list[float] = (np.round(np.asarray(numbers, dtype=float), _DECIMALS) + 0.0).tolist()  # no -0.0
    return rounded


def model_of(values: Mapping[str, Any], limits: Mapping[str, tuple[float, float]] | None = None) -> KinematicModel:
    """The model of these values, whose joints are those of the chain in its order.

    Args:
        values: as `arm_values` returns them.
        limits: joint -> lower and upper limit [rad or m]; None without limits.

    Raises:
        ContractError: if they are not such values.
    """
    try:
        names = tuple(str(joint["name"]) for joint in values["joints"])
        within = [(-np.inf, np.inf) if limits is None else limits[name] for name in names]
        chain = tuple(
            ChainJoint(
                index,
                np.array(joint["position"], dtype=float).reshape(3),
                np.array(joint["rotation"], dtype=float).reshape(3, 3),
                np.array(joint["axis"], dtype=float).reshape(3),
                float(joint["reference"]),
                bool(joint["slides"]),
            )
            for index, joint in enumerate(values["joints"])
        )
        tip = values["tip"]
        pose = TipPose(np.array(tip["position"], float).reshape(3), np.array(tip["rotation"], float).reshape(3, 3))
        lower, upper = np.array(within, dtype=float).reshape(-1, 2).T
        return KinematicModel(names, lower, upper, chain, str(tip["name"]), pose)
    except (KeyError, TypeError, ValueError) as error:
        raise ContractError(f"not the model of an arm: {error!r}") from None
