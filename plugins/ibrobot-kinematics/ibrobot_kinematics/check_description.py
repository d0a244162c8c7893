"""Checks of a robot's frames: models must be trees, and mounts must lead to them without loops."""

from __future__ import annotations

from collections.abc import Iterator

from ibrobot_core.api import OptionFault, did_you_mean
from ibrobot_core.app import RobotConfig
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.frames import MountedFrame, mounted
from ibrobot_kinematics.srdf import read_srdf
from ibrobot_kinematics.urdf import Urdf, read_urdf

_URDF, _SRDF = ("robot", "description", "urdf"), ("robot", "description", "srdf")


def faults(config: RobotConfig) -> Iterator[OptionFault]:
    """All errors, each with its key in the YAML; those in a model also name its file and line."""
    description = config.robot.description
    urdf: Urdf | None = None
    if description.urdf is not None:
        try:
            urdf = read_urdf(description.urdf)
        except KinematicsError as error:
            yield OptionFault(_URDF, str(error))
            return
    if description.srdf is not None:
        if urdf is None:
            yield OptionFault(_SRDF, "needs a URDF, whose links and joints it names: robot.description.urdf")
        else:
            try:
                read_srdf(description.srdf, urdf)
            except KinematicsError as error:
                yield OptionFault(_SRDF, str(error))
    yield from _mounts(list(mounted(config)), urdf)


def _mounts(frames: list[MountedFrame], urdf: Urdf | None) -> Iterator[OptionFault]:
    definers = {link: f"a link of {urdf.path.name}" for link in urdf.links} if urdf is not None else {}
    parents: dict[str, str] = {}
    for frame in frames:
        for name in filter(None, (frame.name, frame.optical)):
            if name in definers:
                message = f"frame {name!r} is already {definers[name]}; set another name in transform.frame"
                yield OptionFault((*_place(frame), "frame"), message)
            definers.setdefault(name, f"a frame of peripheral {frame.peripheral!r}")
        parents.setdefault(frame.name, frame.mount.parent)
        if frame.optical:
            parents.setdefault(frame.optical, frame.name)
    roots: list[str] = []
    for frame in frames:
        place = (*_place(frame), "parent")
        parent = frame.mount.parent
        if urdf is not None and parent not in definers:
            remark = did_you_mean(parent, list(definers), "the frames are")
            yield OptionFault(place, f"frame {frame.name!r} has an unknown parent {parent!r}{remark}")
        chain = [frame.name]
        while chain[-1] in parents and chain[-1] not in chain[:-1]:
            chain.append(parents[chain[-1]])
        if urdf is None and chain[-1] not in chain[:-1]:
            roots.append(chain[-1])
            if roots[-1] != roots[0]:
                message = (
                    f"frame {frame.name!r} is not attached to the others: its root is {chain[-1]!r}, not {roots[0]!r}"
                )
                yield OptionFault(place, message)
        if chain[-1] == frame.name and len(chain) > 1:
            yield OptionFault(place, f"frame {frame.name!r} is its own ancestor: {' -> '.join(reversed(chain))}")


def _place(frame: MountedFrame) -> tuple[str | int, ...]:
    return ("peripherals", frame.index, "transform")
