"""What a run says of places in the base frame: poses of sensors, from `/tf`, and the service of objects."""

from __future__ import annotations

from collections import deque

import numpy as np

from ibrobot_core.api import Pose, TFMessage, TransformStamped, Vector, ns, seconds
from ibrobot_core.app import Received, RunView
from ibrobot_kinematics.poses import matrix
from ibrobot_kinematics.urdf import read_urdf

BASE_FRAMES = ("", "base", "base_link")
"""Names of the base frame beside that of the root of the URDF."""
SHAPES = "/world/shapes"
"""The service that answers with the objects around the robot, in the base frame."""
_FURTHEST = 1000.0
"""Greatest coordinate of a frame [m]."""
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""
_MOST_FRAMES, _MOST_TIMES = 1000, 500
"""Frames, and times of each moving frame, that are remembered; further frames are ignored, the oldest times dropped."""
_MOST_NAMED = 20
_QUEUE = 200
"""Messages that may wait for the next update."""


class UnknownFrame(ValueError):
    """A frame whose pose in the base frame is not known."""


class Frames:
    """The frames of a run. What is on `/tf` moves, and is known at certain times; what is on `/tf_static` is fixed.

    Transforms that are not finite, or whose quaternion is not of length 1, are ignored.
    """

    def __init__(self, session: RunView) -> None:
        self._clock = session.clock
        bus = session.bus
        self._fixed_messages = bus.subscribe("/tf_static", _QUEUE, TFMessage)
        self._moving_messages = bus.subscribe("/tf", _QUEUE, TFMessage)
        self._fixed: dict[str, TransformStamped] = {}
        self._moving: dict[str, deque[tuple[int, TransformStamped]]] = {}
        """Frame -> times of measurement [ns] and transforms."""
        self._malformed: dict[str, str] = {}
        """Frame -> what is wrong with its newest transform."""
        description = session.config.robot.description
        if description.urdf is not None:
            roots = {read_urdf(description.urdf).root}
        else:
            mounts = [each.transform for each in session.config.peripherals.values()]
            roots = {mount.parent for mount in mounts if mount is not None}
        self._bases = {*filter(None, BASE_FRAMES), *roots}

    def close(self) -> None:
        """End the subscriptions."""
        self._fixed_messages.close()
        self._moving_messages.close()

    def update(self) -> None:
        """Take the transforms that have come."""
        for received in self._fixed_messages.drain():
            for each in self._usable(received):
                self._fixed[each.child_frame_id] = each
        for received in self._moving_messages.drain():
            for each in self._usable(received):
                times = self._moving.setdefault(each.child_frame_id, deque(maxlen=_MOST_TIMES))
                stamp_ns = each.header.stamp_ns or received.received_ns
                times.append((self._clock.now_ns() - self._clock.age_ns(stamp_ns), each))

    def pose(self, frame: str, at_ns: int, tolerance_s: float) -> Vector:
        """Pose of a frame in the base frame, shape (4, 4).

        Args:
            frame: its name.
            at_ns: when [ns].
            tolerance_s: greatest difference between that and the time of a transform on `/tf` [s].

        Raises:
            UnknownFrame: for a frame that is unknown, not connected to the base, or not known at that time.
        """
        self.update()
        root, placed = self._in_root(frame, at_ns, tolerance_s)
        if root in self._bases:
            return placed
        for base in sorted(self._bases & self._known()):
            if (above := self._in_root(base, at_ns, tolerance_s, beyond_base=True))[0] == root:
                return np.asarray(np.linalg.inv(above[1]) @ placed)
        raise self._no_transform(frame, root)

    def _in_root(self, frame: str, at_ns: int, tolerance_s: float, *, beyond_base: bool = False) -> tuple[str, Vector]:
        """The base or, if there is none above a frame, the root of its tree; and the frame's pose in it."""
        placed, passed = np.eye(4), {frame}
        here = frame
        while here in self._known() and (here not in self._bases or (beyond_base and here == frame)):
            transform = self._transform(here, at_ns, tolerance_s)
            placed = matrix(Pose(transform.translation, transform.rotation)) @ placed
            here = transform.header.frame_id
            if here in passed:
                raise UnknownFrame(f"the transforms of frame {frame!r} run in a circle by way of {here!r}")
            passed.add(here)
        return here, placed

    def _transform(self, frame: str, at_ns: int, tolerance_s: float) -> TransformStamped:
        if frame not in self._moving:
            return self._fixed[frame]
        then_ns, nearest = min(self._moving[frame], key=lambda each: abs(each[0] - at_ns))
        if abs(then_ns - at_ns) > ns(tolerance_s):
            raise UnknownFrame(
                f"the nearest transform of frame {frame!r} on /tf is {seconds(abs(then_ns - at_ns)):.1f} s from the"
                f" time of the message, at most {tolerance_s:g} s is allowed (transform_tolerance)",
            )
        return nearest

    def _known(self) -> set[str]:
        return self._fixed.keys() | self._moving.keys()

    def _usable(self, received: Received) -> list[TransformStamped]:
        """The transforms of a message that are poses."""
        message = received.message
        assert isinstance(message, TFMessage)
        usable = []
        for each in message.transforms:
            known = self._known()
            if each.child_frame_id not in known and len(known | self._malformed.keys()) >= _MOST_FRAMES:
                continue
            if fault := _fault(each):
                self._malformed[each.child_frame_id] = fault
            else:
                self._malformed.pop(each.child_frame_id, None)
                usable.append(each)
        return usable

    def _no_transform(self, frame: str, root: str) -> UnknownFrame:
        names = sorted(self._known())
        known = ", ".join(names[:_MOST_NAMED]) + (
            f" and {len(names) - _MOST_NAMED} more" if names[_MOST_NAMED:] else ""
        )
        if fault := self._malformed.get(root):
            why = f"that of {root!r} was ignored: {fault}"
        elif root != frame:
            why = f"its tree ends at {root!r}, which is not the base ({', '.join(sorted(self._bases))})"
        else:
            why = f"known frames: {known or 'none'}"
        return UnknownFrame(
            f"no transform of frame {frame!r} to the base; peripherals[].transform says where a camera is mounted;"
            f" {why}",
        )


def _fault(transform: TransformStamped) -> str:
    """What is wrong with a transform; empty if it is a pose."""
    t, q = transform.translation, transform.rotation
    if not (np.abs([t.x, t.y, t.z]) <= _FURTHEST).all():  # so that NaN fails it, as below
        return f"its translation is ({t.x:g}, {t.y:g}, {t.z:g}) m"
    length = float(np.linalg.norm([q.x, q.y, q.z, q.w]))
    return "" if abs(length - 1) <= _NEARLY_ONE else f"its quaternion has length {length:.3g}, must have 1"
