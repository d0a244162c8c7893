"""Where cameras see what moves against them, drawn by another package if one is installed that can."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from typing import Protocol

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import CameraInfo, IbrobotError, Vector
from ibrobot_core.app import RobotConfig, installed_plugins
from ibrobot_diagnose.cause import ARM_VIEW
from ibrobot_diagnose.rig import Rig, RigCamera


class ArmView(Protocol):
    """Draws the arm in a camera."""

    stands: bool
    """Whether the camera stands beside the arm; otherwise it is on the arm."""

    def moving(self, positions: Vector) -> NDArray[np.bool_]:
        """Where something may move against the camera, for positions of the joints [rad]; shape (H, W)."""

    def close(self) -> None:
        """Release what it holds."""


def with_moving(
    rigs: tuple[Rig, Rig], config: RobotConfig, infos: Mapping[str, CameraInfo]
) -> tuple[Rig, Rig, tuple[str, ...]]:
    """Two rigs whose stills know where the arm is, as far as it can be drawn; and why it cannot.

    Args:
        rigs: those that are compared.
        config: the robot.
        infos: topic of a camera's pictures -> what the camera says of itself.
    """
    notes: dict[str, None] = {}
    peripherals = {each.key: each.peripheral for each in config.contract.observations if each.peripheral is not None}
    cameras: tuple[dict[str, RigCamera], ...] = ({}, {})
    for key in rigs[0].cameras.keys() & rigs[1].cameras.keys():
        name = peripherals.get(key)
        pair = [rig.cameras[key] for rig in rigs]
        if name is None or pair[0].stills[0].picture.shape != pair[1].stills[0].picture.shape:
            continue
        try:
            drawn = list(_drawn(pair, rigs, config, name, infos.get(key)))
        except IbrobotError as error:
            notes[f"the arm is not masked in {key.rpartition('.')[2]}: {error}"] = None
            continue
        for known, camera in zip(cameras, drawn, strict=True):
            known[key] = camera
    one, other = (attrs.evolve(rig, cameras={**rig.cameras, **known}) for rig, known in zip(rigs, cameras, strict=True))
    return one, other, tuple(notes)


def _drawn(
    pair: list[RigCamera], rigs: tuple[Rig, Rig], config: RobotConfig, name: str, info: CameraInfo | None
) -> Iterator[RigCamera]:
    views = installed_plugins().of_kind(ARM_VIEW)
    if not views:
        raise IbrobotError("no installed package draws it; ibrobot-plugin-mujoco does")
    known = set(config.robot.joint_names)
    if foreign := [joint for rig in rigs for joint in rig.joints if joint not in known]:
        raise IbrobotError(f"the robot has no joint {foreign[0]!r}, as the reference has")
    height, width = pair[0].stills[0].picture.shape[:2]
    columns = [config.robot.indices(rig.joints) for rig in rigs]
    with closing(views[0].make(config, name, info, (height, width))) as view:  # type: ignore[call-arg, arg-type]
        for camera, at in zip(pair, columns, strict=True):
            stills = []
            for still in camera.stills:
                pose = np.zeros(len(config.robot.joint_names))
                pose[at] = still.pose
                is_known = bool(np.isfinite(still.pose).all())
                stills.append(attrs.evolve(still, moving=view.moving(pose) if is_known else None))
            yield attrs.evolve(camera, stills=tuple(stills), stands=view.stands)
