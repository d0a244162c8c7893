"""Pictures of the board from a recorded episode: one for each time the arm stood still."""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import attrs
import cv2
import numpy as np
from numpy.typing import NDArray

from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.intrinsics.views import find
from ibrobot_camera.mounting.shots import Lens, Shot, shot_of
from ibrobot_core.api import (
    JOINT_STATES,
    NS_PER_S,
    CameraInfo,
    CompressedImage,
    EpisodeReader,
    Image,
    JointState,
    SensorError,
    Vector,
    pixels,
)
from ibrobot_core.app import installed_plugins

_AROUND_NS = NS_PER_S // 10
"""The arm stands still before and after a picture for at least this time [ns]."""
_STILL = 0.005
"""Greatest motion of a joint in this time [rad or m]."""
_FEWEST_STATES = 3
_OTHER_POSE = 0.02
"""Least difference of a joint from which the arm stands elsewhere [rad or m]."""
_UNMOVED = 20
"""Pictures that are taken if neither camera nor board moves with the arm."""
_BLURRED = 0.75
"""Share of a picture's edges that remains in its blurred copy, from which it is blurred itself."""


@attrs.define
class Taken:
    """The pictures that can be used, and why others cannot."""

    shots: list[Shot] = attrs.field(factory=list)
    stops: int = 0
    others: Counter[str] = attrs.field(factory=Counter)
    """Why a picture cannot be used -> number of pictures."""

    def text(self) -> str:
        """How often the arm stood still, and why pictures cannot be used, for messages."""
        why = "; ".join(f"{count} {what}" for what, count in self.others.most_common())
        return f"the arm stood still {self.stops} times" + (f", but {why}" if why else "")


@attrs.frozen
class Source:
    """What is read of an episode.

    Args:
        camera: topic of the camera's pictures.
        joints: names of the joints, in the order of vectors.
        columns: the joints that move between camera and board.
        board: the board.
        info: the calibration of the camera in its YAML; None if there is none.
    """

    camera: str
    joints: Sequence[str]
    columns: Sequence[int]
    board: Board
    info: CameraInfo | None

    def read(self, path: Path, name: str) -> tuple[Taken, Lens]:
        """The pictures of an episode, and the camera's lens.

        Args:
            path: the episode.
            name: what messages call it; empty if there is only one.

        Raises:
            IbrobotError: if it cannot be read, or lacks joint states, pictures or a calibration.
        """
        with closing(installed_plugins().open_episode(path)) as reader:
            topics = reader.summary().topics
            for topic, what in ((JOINT_STATES, "joint states"), (self.camera, "pictures")):
                if topic not in topics:
                    raise SensorError(f"{path}: has no {what} ({topic}); it has: {', '.join(sorted(topics))}")
            lens = self._lens(reader, path)
            stamps, positions = self._states(reader, path)
            stops = self._stops(stamps, positions) if len(stamps) else []
            taken = Taken(stops=len(stops))
            start_ns = reader.summary().start_ns
            for stamp_ns, picture in self._pictures(reader, stops).items():
                at = f"{name}{(stamp_ns - start_ns) / NS_PER_S:.1f} s"
                self._take(taken, picture, at, _between(stamps, positions, stamp_ns), lens)
            return taken, lens

    def _lens(self, reader: EpisodeReader, path: Path) -> Lens:
        topic = f"{self.camera.rpartition('/')[0]}/camera_info"
        infos = (item.message for item in reader.messages((topic,)))
        info = next((each for each in infos if isinstance(each, CameraInfo) and each.k.any()), self.info)
        if info is None:
            raise SensorError(
                f"{path}: the camera has no calibration on {topic}: measure its lens with `ibrobot camera calibrate`, "
                "and put the file into the robot YAML as `info`"
            )
        try:
            return Lens.of(info)
        except SensorError as error:
            raise SensorError(f"{path}: {self.camera}: {error}") from None

    def _states(self, reader: EpisodeReader, path: Path) -> tuple[NDArray[np.int64], Vector]:
        """Stamps [ns], shape (N,), and positions, shape (N, J)."""
        stamps, rows = [], []
        for item in reader.messages((JOINT_STATES,)):
            message = item.message
            assert isinstance(message, JointState)
            at = {joint: i for i, joint in enumerate(message.name)}
            if missing := [joint for joint in self.joints if joint not in at]:
                raise SensorError(
                    f"{path}: {JOINT_STATES} has no joint {missing[0]!r}; it has: {', '.join(message.name)}"
                )
            stamps.append(message.header.stamp_ns or item.received_ns)
            rows.append([message.position[at[joint]] for joint in self.joints])
        order = np.argsort(np.array(stamps, np.int64), kind="stable")
        return np.array(stamps, np.int64)[order], np.array(rows).reshape(-1, len(self.joints))[order]

    def _stops(self, stamps: NDArray[np.int64], positions: Vector) -> list[tuple[int, int]]:
        """Beginning and end [ns] of the times in which the arm stands still, each in a pose of its own."""
        if not self.columns:
            parts = np.linspace(stamps[0], stamps[-1], _UNMOVED + 1).astype(np.int64).tolist()
            return list(pairwise(parts))
        own = positions[:, self.columns]
        low, high = (np.searchsorted(stamps, stamps + sign * _AROUND_NS) for sign in (-1, 1))
        stops: list[tuple[int, int]] = []
        poses: list[Vector] = []
        begin: int | None = None
        for i, (first, last) in enumerate(zip(low.tolist(), high.tolist(), strict=True)):
            near = own[first:last]
            still = len(near) >= _FEWEST_STATES and float(np.ptp(near, axis=0).max()) < _STILL
            if still and begin is None:
                begin = i
            if begin is not None and (not still or i == len(own) - 1):
                pose = own[(begin + i) // 2]
                if all(np.abs(pose - other).max() > _OTHER_POSE for other in poses):
                    stops.append((int(stamps[begin]), int(stamps[i])))
                    poses.append(pose)
                begin = None
        return stops

    def _pictures(self, reader: EpisodeReader, stops: Sequence[tuple[int, int]]) -> dict[int, Image]:
        """Stamp [ns] -> the picture that is nearest to the middle of each stop."""
        begins = [begin for begin, _ in stops]
        nearest: dict[int, tuple[int, int, Image]] = {}
        for item in reader.messages((self.camera,)):
            message = item.message
            if isinstance(message, CompressedImage):
                message = installed_plugins().decode(message)
            if not isinstance(message, Image):
                raise SensorError(f"{self.camera}: has {message.ros_type}, no pictures")
            stamp_ns = message.header.stamp_ns or item.received_ns
            stop = bisect_right(begins, stamp_ns) - 1
            if stop < 0 or stamp_ns > stops[stop][1]:
                continue
            off = abs(2 * stamp_ns - sum(stops[stop]))
            if stop not in nearest or off < nearest[stop][0]:
                nearest[stop] = off, stamp_ns, message
        return {stamp_ns: picture for _, stamp_ns, picture in (nearest[stop] for stop in sorted(nearest))}

    def _take(self, taken: Taken, picture: Image, name: str, joints: Vector, lens: Lens) -> None:
        shown = np.asarray(pixels(picture), np.uint8)
        if shown.ndim == 3:
            colours = cv2.COLOR_BGR2GRAY if picture.encoding.startswith("bgr") else cv2.COLOR_RGB2GRAY
            shown = np.asarray(cv2.cvtColor(np.ascontiguousarray(shown[..., :3]), colours), np.uint8)
        view = find(shown, self.board, name)
        if view is None:
            taken.others["pictures are blurred" if _is_blurred(shown) else "pictures show too little of the board"] += 1
        elif (shot := shot_of(view, joints, lens)) is None:
            taken.others["show corners that do not fit a flat board with these squares"] += 1
        else:
            taken.shots.append(shot)


def _between(stamps: NDArray[np.int64], positions: Vector, stamp_ns: int) -> Vector:
    """The positions at a time, interpolated, shape (J,)."""
    own = (stamps - stamps[0]).astype(np.float64)
    return np.array([np.interp(float(stamp_ns - stamps[0]), own, column) for column in positions.T])


def _is_blurred(grey: NDArray[np.uint8]) -> bool:
    """Whether a picture has nearly no sharp edges: these are what another blur takes away."""
    values = grey.astype(np.float32)
    edges = [np.abs(np.diff(each, axis=1)).mean() for each in (values, cv2.blur(values, (5, 5)))]
    return bool(edges[1] > _BLURRED * edges[0])
