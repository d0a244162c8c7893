"""The component of the section: the service `/find`, with the detectors."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from typing import override

import attrs
import numpy as np
from ibrobot_kinematics.run_frames import Frames, UnknownFrame
from ibrobot_kinematics.visible_names import name_fault
from ibrobot_ros2.run_cameras import camera_info, chosen_cameras, next_pictures, rgb
from numpy.typing import NDArray

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    ContractError,
    IbrobotError,
    Image,
    Message,
    SensorError,
    Vector,
)
from ibrobot_core.app import CONTROL, Component, RunView, Service, error_text
from ibrobot_detect.detector import Detection, Detector, Seen, Sight
from ibrobot_detect.options import SECTION, DetectOptions, Find, options_of

_GLANCE_S = 0.02
"""Interval at which transforms are looked for [s]."""
_PLUMB_BOB = 5
"""Numbers of the distortion that are used."""
_MOST = 1000
"""Most objects that a detector may find."""
_FURTHEST_M = 1000.0
"""Greatest coordinate of an object [m]."""
_NEARLY_ONE = 1e-3
"""Allowed deviation of a quaternion's length from 1."""


@attrs.frozen
class FoundObject:
    """An object that a detector has found."""

    name: str
    detector: str
    position_m: tuple[float, float, float]
    """In the robot's base frame, as goals of motions have it."""
    quaternion_xyzw: tuple[float, float, float, float]
    size_m: tuple[float, ...]
    """Lengths along its own axes; empty if they are not known."""
    score: float
    """0 to 1: how sure the detector is."""
    seen: tuple[Seen, ...]


@attrs.frozen
class Found:
    """The answer of `/find`."""

    objects: tuple[FoundObject, ...]
    without: Mapping[str, str]
    """Camera that was not used -> why."""


FIND = Service(
    "/find", Find, Found, "Find objects by name, or at a place of a picture, with their poses.", "name", reads=True
)


class Finder(Component):
    """Serves `/find`.

    Args:
        options: the detectors.
        session: the run.
    """

    def __init__(self, options: DetectOptions | None, session: RunView) -> None:
        self._options = options or DetectOptions()
        super().__init__(SECTION, f"finds objects: {', '.join(self._options.use)}", (CONTROL,))
        self._session = session
        self._detectors: dict[str, tuple[Detector, bool]] = {}
        """Type -> the detector, and whether it looks at pictures."""
        self._lock = threading.Lock()

    @override
    def start(self) -> None:
        for type_, plain in self._options.use.items():
            descriptor, options = options_of(type_, plain)
            self._detectors[type_] = descriptor.make(options, self._session), descriptor.pictures
        self._session.bus.serve(FIND, self._find)

    @override
    def stop(self) -> None:
        self._session.bus.unserve(FIND)
        with self._lock, ExitStack() as stack:  # if one raises, the others are still closed
            for detector, _ in self._detectors.values():
                stack.callback(detector.close)
            self._detectors.clear()

    def _find(self, wanted: Find) -> Found:
        topics = chosen_cameras(self._session, wanted.camera)
        looks = any(pictures for _, pictures in self._detectors.values())
        with closing(Frames(self._session)) as frames:
            taken = next_pictures(self._session, topics, wanted.timeout) if looks else {}
            sights, without = self._sights(topics, taken, frames, wanted.timeout)
        if wanted.camera and wanted.camera in without:
            raise SensorError(f"camera {wanted.camera}: {without[wanted.camera]}")
        with self._lock:
            objects = [
                each
                for type_, (detector, pictures) in self._detectors.items()
                for each in self._found(
                    type_, detector, wanted.name, [s for s in sights if not pictures or s.pixels is not None]
                )
            ]
        if wanted.at:
            objects = _at(objects, wanted.camera, wanted.at)
        return Found(tuple(objects), without)

    def _found(self, type_: str, detector: Detector, name: str, sights: Sequence[Sight]) -> list[FoundObject]:
        """What a detector finds, checked: other packages have detectors, and motions go to what they say.

        Raises:
            SensorError: if it fails, or breaks its promises.
        """
        try:
            detections = detector.find(name, sights)
            if not isinstance(detections, Sequence):
                raise ValueError(f"its result is {detections!r:.80}, must be a list of Detection")
            if len(detections) > _MOST:
                raise ValueError(f"its result has {len(detections)} objects, at most {_MOST} are allowed")
            return [_checked(type_, each) for each in detections]
        except IbrobotError:
            raise
        except ValueError as error:
            raise SensorError(f"detector {type_}: {error}") from error
        except Exception as error:
            self._session.log.exception("detector %s failed", type_)
            raise SensorError(f"detector {type_}: it failed: {error_text(error)}") from error

    def _sights(
        self, topics: Mapping[str, str], taken: Mapping[str, Message], frames: Frames, timeout_s: float
    ) -> tuple[list[Sight], dict[str, str]]:
        """The cameras with intrinsics and a pose, and why the others lack them."""
        sights, without, now_ns = [], dict[str, str](), self._session.clock.now_ns()
        for name, topic in topics.items():
            try:
                info = _usable(camera_info(self._session, topic))
                picture = None if name not in taken else _picture(taken[name], info)
                message = taken.get(name)
                stamp_ns = message.header.stamp_ns if isinstance(message, Image | CompressedImage) else now_ns
                pose = self._pose(frames, info.header.frame_id, stamp_ns, timeout_s)
            except (UnknownFrame, ContractError, ValueError) as error:
                without[name] = str(error)
                continue
            distortion = np.zeros(_PLUMB_BOB)
            distortion[: len(info.d)] = info.d[:_PLUMB_BOB]
            size = (info.width, info.height)
            sights.append(Sight(name, stamp_ns, picture, size, info.k.reshape(3, 3), distortion, pose))
        return sights, without

    def _pose(self, frames: Frames, frame: str, stamp_ns: int, timeout_s: float) -> NDArray[np.float64]:
        """The pose of a frame at a time; waits for the next transforms, since `frames` knows none from before."""
        wait = threading.Event().wait
        for _ in range(int(min(timeout_s, self._options.transform_tolerance) / _GLANCE_S)):
            try:
                return frames.pose(frame, stamp_ns, self._options.transform_tolerance)
            except UnknownFrame:
                if "/tf" not in self._session.bus.topics():
                    raise
                wait(_GLANCE_S)
        return frames.pose(frame, stamp_ns, self._options.transform_tolerance)


def _usable(info: CameraInfo | None) -> CameraInfo:
    """A calibration with which pixels have directions.

    Raises:
        ValueError: for another one.
    """
    if info is None or not info.k.any():
        raise ValueError("it has no calibration; `ibrobot camera calibrate` makes one")
    if info.distortion_model != "plumb_bob" or len(info.d) > _PLUMB_BOB:
        raise ValueError(f"distortion model {info.distortion_model} is not supported; plumb_bob is")
    if not np.isfinite([*info.k, *info.d]).all() or min(info.k[0], info.k[4]) <= 0 or min(info.width, info.height) <= 1:
        raise ValueError("its calibration has no finite focal lengths")
    return info


def _picture(message: Message, info: CameraInfo) -> NDArray[np.uint8] | None:
    """The colours of a picture; None if it has none, e.g. depth.

    Raises:
        ValueError: if it has another size than the calibration.
    """
    colours = rgb(message)
    if colours is not None and colours.shape[:2] != (info.height, info.width):
        height, width, _ = colours.shape
        raise ValueError(
            f"its pictures have {width} x {height} pixels, its calibration is for {info.width} x {info.height}"
        )
    return colours


def _checked(detector: str, each: Detection) -> FoundObject:
    """A detection as the service answers it.

    Raises:
        ValueError: for one that is not as `Detection` says.
    """
    if not isinstance(each, Detection):
        raise ValueError(f"its result has {each!r:.80}, must be Detection")
    if not isinstance(each.name, str):
        raise ValueError(f"its name is {each.name!r:.80}, must be text")
    if why := name_fault(each.name):
        raise ValueError(why)
    try:
        p, q = each.pose.position, each.pose.orientation
        place, turn = np.array([p.x, p.y, p.z], float), np.array([q.x, q.y, q.z, q.w], float)
        size, score = np.array(each.size_m, float).reshape(-1), float(each.score)
        boxes = {seen.camera: np.array(seen.box_px, float).reshape(4) for seen in each.seen}
    except (AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"{each.name!r:.80}: {error}") from error
    if why := _fault(place, turn, size, score, boxes):
        raise ValueError(f"{each.name!r:.80}: {why}")
    x, y, z = np.round(place, 5).tolist()
    quaternion = tuple(np.round(turn, 6).tolist())
    seen = tuple(Seen(str(camera), tuple(box.tolist())) for camera, box in boxes.items())
    return FoundObject(each.name, detector, (x, y, z), quaternion, tuple(np.round(size, 5).tolist()), score, seen)


def _fault(place: Vector, turn: Vector, size: Vector, score: float, boxes: Mapping[str, Vector]) -> str:
    """What is wrong with the numbers of a detection; empty for nothing. NaN fails each comparison."""
    if not (np.abs(place) <= _FURTHEST_M).all():
        return f"its pose is not finite, or more than {_FURTHEST_M:g} m away"
    if not abs(math.hypot(*turn) - 1) <= _NEARLY_ONE:
        return f"its quaternion has length {math.hypot(*turn):.3g}, must have 1"
    if not 0 <= score <= 1:
        return f"its score is {score:g}, must be 0 to 1"
    if not (np.isfinite(size) & (size >= 0)).all():
        return "its size is not finite, or negative"
    beyond = [camera for camera, box in boxes.items() if not np.isfinite(box).all()]
    return f"its box in the picture of {beyond[0]} is not finite" if beyond else ""


def _at(objects: Sequence[FoundObject], camera: str, place: Sequence[float]) -> list[FoundObject]:
    """The objects that a camera sees at a place, the one that fills least of the picture first."""

    def areas(each: FoundObject) -> Iterator[float]:
        for seen in each.seen:
            left, top, right, bottom = seen.box_px
            if seen.camera == camera and left <= place[0] <= right and top <= place[1] <= bottom:
                yield (right - left) * (bottom - top)

    there = [(min(areas(each)), each) for each in objects if any(True for _ in areas(each))]
    return [each for _, each in sorted(there, key=lambda pair: pair[0])]
