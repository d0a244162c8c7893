"""Checks of a robot's models: joints and their limits, the tip, trees of links, and mounts without loops."""

from __future__ import annotations

import math
from collections.abc import Iterator

import attrs

from ibrobot_core.api import Joint, OptionFault, did_you_mean
from ibrobot_core.app import RobotConfig
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.frames import MountedFrame, mounted
from ibrobot_kinematics.mjcf_names import MjcfNames, read_names
from ibrobot_kinematics.srdf import read_srdf
from ibrobot_kinematics.urdf import Urdf, read_urdf

_AT = ("robot", "description")
_SLACK = 0.01
"""Tolerance for limits wider than a model's [rad], since both may be rounded."""


@attrs.frozen
class _Limits:
    """Limits of a joint in a model [rad, or m for a sliding joint], with the file and line."""

    lower: float
    upper: float
    place: str


def faults(config: RobotConfig) -> Iterator[OptionFault]:
    """All errors, each with its key in the YAML; those in a model also name its file and line."""
    description = config.robot.description
    names: MjcfNames | None = None
    urdf: Urdf | None = None
    broken: list[OptionFault] = []
    if description.mjcf is not None:
        try:
            names = read_names(description.mjcf)
        except KinematicsError as error:
            broken.append(OptionFault((*_AT, "mjcf"), str(error)))
    if description.urdf is not None:
        try:
            urdf = read_urdf(description.urdf)
        except KinematicsError as error:
            broken.append(OptionFault((*_AT, "urdf"), str(error)))
    yield from broken
    yield from _joints(config, names, urdf)
    if broken:
        return
    yield from _tip(config, names, urdf)
    if description.srdf is not None:
        if urdf is None:
            yield OptionFault((*_AT, "srdf"), "needs a URDF, whose links and joints it names: robot.description.urdf")
        else:
            try:
                read_srdf(description.srdf, urdf)
            except KinematicsError as error:
                yield OptionFault((*_AT, "srdf"), str(error))
    yield from _mounts(list(mounted(config)), urdf)


def _joints(config: RobotConfig, names: MjcfNames | None, urdf: Urdf | None) -> Iterator[OptionFault]:
    """Check that the MJCF has the joints, and that their limits are within those of a model."""
    models: list[dict[str, _Limits]] = []
    if names is not None:
        models.append({name: _Limits(*ends, names.places[name]) for name, ends in names.limits.items()})
    if urdf is not None:
        models.append(
            {
                joint.name: _Limits(*joint.limits, f"{urdf.path.name}:{joint.element.line}")
                for joint in urdf.joints
                if joint.limits is not None
            }
        )
    robot = config.robot
    for i, joint in enumerate(robot.joints):
        name = joint.name.removeprefix(robot.description.arm_of(joint.name))
        # The simulation has its own error for joints that are missing.
        if names is not None and not config.simulated and name not in names.joints:
            remark = did_you_mean(name, names.joints, "it has")
            yield OptionFault((*_AT, "mjcf"), f"the model has no joint {name!r}{remark}")
        limits = [each[name] for each in models if name in each]
        if limits and not joint.beyond_model:
            yield from _within(("robot", "joints", i), joint, limits)


def _within(key: tuple[str | int, ...], joint: Joint, limits: list[_Limits]) -> Iterator[OptionFault]:
    lowest, highest = min(limits, key=lambda each: each.lower), max(limits, key=lambda each: each.upper)
    for end, value, widest, excess in (
        ("lower", joint.lower, lowest, lowest.lower - joint.lower),
        ("upper", joint.upper, highest, joint.upper - highest.upper),
    ):
        if excess <= _SLACK:
            continue
        remedy = f"narrow it, or set beyond_model: true where {joint.name} can go there"
        if abs(value) > 2 * math.pi:
            remedy = f"were degrees meant? {value:g} degrees are {math.radians(value):.5g} rad"
        model = f"{widest.lower:g} to {widest.upper:g} rad ({widest.place})"
        yield OptionFault((*key, end), f"{value:g} rad is beyond the model's limits, {model}; {remedy}")


def _tip(config: RobotConfig, names: MjcfNames | None, urdf: Urdf | None) -> Iterator[OptionFault]:
    """Check that a model has the tip that the YAML names."""
    written = (config.document.get("robot") or {}).get("description") or {}
    sites, links = names.sites if names is not None else (), urdf.links if urdf is not None else ()
    tip, frames = config.robot.description.tip, (*sites, *links)
    if written.get("tip") is not None and (names or urdf) and tip not in frames:
        what = " or ".join(kind for kind, model in (("site", names), ("link", urdf)) if model is not None)
        yield OptionFault((*_AT, "tip"), f"unknown {what} {tip!r}{did_you_mean(tip, frames, 'known')}")


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
