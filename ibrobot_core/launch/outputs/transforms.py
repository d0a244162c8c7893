"""Transforms: `/tf` and `/tf_static` from the URDF and the joint states, as robot_state_publisher does."""

from __future__ import annotations

import math
from pathlib import Path
from typing import override
from xml.etree import ElementTree

import attrs
import numpy as np

from ibrobot_core.bus import Subscription
from ibrobot_core.errors import ConfigError, Problem
from ibrobot_core.launch.session import Session, SessionWorker
from ibrobot_core.messages import Header, JointState, Quaternion, TFMessage, TransformStamped, Vector3

_MOVING = ("revolute", "continuous", "prismatic")


@attrs.frozen
class Link:
    """A URDF joint: how its child link stands in its parent link. Source: http://wiki.ros.org/urdf/XML/joint."""

    joint: str
    type: str
    parent: str
    child: str
    origin: Vector3
    """[m]."""
    rotation: Quaternion
    axis: tuple[float, float, float]
    """Unit vector in the child's frame."""

    def transform(self, position: float, stamp_ns: int) -> TransformStamped:
        """The transform at a joint position [rad or m]."""
        translation, rotation = self.origin, self.rotation
        x, y, z = self.axis
        if self.type == "prismatic":
            moved = _rotate(rotation, (x * position, y * position, z * position))
            translation = Vector3(translation.x + moved[0], translation.y + moved[1], translation.z + moved[2])
        elif self.type != "fixed":
            half = math.sin(position / 2)
            rotation = _product(rotation, Quaternion(x * half, y * half, z * half, math.cos(position / 2)))
        return TransformStamped(Header(stamp_ns, self.parent), self.child, translation, rotation)


def read_urdf(path: Path) -> list[Link]:
    """The joints of a URDF, in file order.

    Raises:
        ConfigError: when it cannot be read, or is not a URDF.
    """
    try:
        root = ElementTree.parse(path).getroot()
        return [_link(element) for element in root.iterfind("joint")]
    except (OSError, ElementTree.ParseError, ValueError, AttributeError) as error:
        raise ConfigError([Problem(str(path), 0, "", f"is not a URDF: {error}")]) from None


def _link(joint: ElementTree.Element) -> Link:
    names = {}
    for end in ("parent", "child"):
        element = joint.find(end)
        if element is None:
            raise ValueError(f"joint {joint.get('name')!r} has no {end}")
        names[end] = element.get("link", "")
    origin, axis = joint.find("origin"), joint.find("axis")
    x, y, z = _triple(origin, "xyz", "0 0 0")
    direction = np.array(_triple(axis, "xyz", "1 0 0"))
    length = float(np.linalg.norm(direction)) or 1.0
    ax, ay, az = (direction / length).tolist()
    return Link(
        joint.get("name", ""), joint.get("type", "fixed"), names["parent"], names["child"], Vector3(x, y, z),
        _from_rpy(*_triple(origin, "rpy", "0 0 0")), (ax, ay, az),
    )  # fmt: skip


def _triple(element: ElementTree.Element | None, attribute: str, default: str) -> tuple[float, float, float]:
    text = default if element is None else element.get(attribute, default)
    first, second, third = (float(number) for number in text.split())
    return first, second, third


def _from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Fixed-axis roll, pitch, yaw [rad], as URDF has them."""
    result = Quaternion(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    result = _product(result, Quaternion(0.0, math.sin(pitch / 2), 0.0, math.cos(pitch / 2)))
    return _product(result, Quaternion(math.sin(roll / 2), 0.0, 0.0, math.cos(roll / 2)))


def _product(a: Quaternion, b: Quaternion) -> Quaternion:
    return Quaternion(
        a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
    )


def _rotate(q: Quaternion, vector: tuple[float, float, float]) -> tuple[float, float, float]:
    turned = _product(_product(q, Quaternion(*vector, 0.0)), Quaternion(-q.x, -q.y, -q.z, q.w))
    return turned.x, turned.y, turned.z


class Transforms(SessionWorker):
    """Publishes the moving links with every joint state, and the fixed ones once, latched."""

    def __init__(self, session: Session, urdf: Path, needs: tuple[str, ...]) -> None:
        super().__init__(session, "transforms", f"/tf from {urdf.name}", needs)
        self._urdf = urdf
        self._states: Subscription | None = None

    @override
    def setup(self) -> None:
        session = self.session
        links = read_urdf(self._urdf)
        known = {name: i for i, name in enumerate(session.config.robot.joint_names)}
        self._moving = [(link, known[link.joint]) for link in links if link.type in _MOVING and link.joint in known]
        fixed = tuple(link.transform(0.0, session.clock.now_ns()) for link in links if link.type == "fixed")
        session.bus.publish("/tf_static", TFMessage(fixed), latched=True)
        unknown = [link.joint for link in links if link.type in _MOVING and link.joint not in known]
        if unknown:
            session.log.warning("no /tf for %s: not among robot.joints, but in %s", ", ".join(unknown), self._urdf)
        self._states = session.bus.subscribe("/joint_states", 1)

    @override
    def work(self, timeout_s: float) -> None:
        assert self._states is not None
        received = self._states.get(timeout_s)
        if received is None:
            return
        state = received.message
        assert isinstance(state, JointState)
        positions = state.position.tolist()
        stamp_ns = state.header.stamp_ns
        transforms = tuple(link.transform(positions[i], stamp_ns) for link, i in self._moving)
        self.session.bus.publish("/tf", TFMessage(transforms))

    @override
    def teardown(self) -> None:
        if self._states is not None:
            self._states.close()
