"""Point clouds and depth images as occupied cells of the world."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from types import NoneType
from typing import Any, override

import attrs
import numpy as np
from ibrobot_kinematics.poses import matrix
from ibrobot_kinematics.run_frames import Frames, UnknownFrame

from ibrobot_core.api import (
    DIAGNOSTICS,
    CameraInfo,
    ContractError,
    DiagnosticArray,
    DiagnosticStatus,
    Header,
    Image,
    KeyValue,
    Message,
    PointCloud2,
    Vector,
    ns,
    pixels,
    seconds,
)
from ibrobot_core.app import CONTROL, NoRequest, Received, RunView, Service, SessionWorker
from ibrobot_planning.world.ages import Age, AgeSummary, Unusable
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.coal_shapes import geometry
from ibrobot_planning.world.objects import Voxels, WorldObject
from ibrobot_planning.world.options import CloudOptions, WorldOptions
from ibrobot_planning.world.section import WorldKeeper
from ibrobot_planning.world.voxels import (
    MOST_POINTS,
    check_intrinsics,
    cloud_points,
    depth_points,
    is_depth,
    is_measured,
    outside,
    voxels,
)

CLEAR = Service(
    "/clear_octomap", NoRequest, NoneType, "Remove the cells of all clouds until the next message.", persons=True
)
"""MoveIt's name."""
_PIXELS = 3
"""Pixels along the edge of a cell at the furthest distance; images are thinned to about this."""
_USUAL = 10
"""Number of earlier messages with which a message is compared to find out whether the sensor is covered."""
_DIAGNOSTICS_S = 1.0
_GLANCE_S = 0.1
"""Interval at which the ages are checked without clouds [s]."""


@attrs.frozen(eq=False)
class _Seen:
    """What a message of a sensor measures."""

    points: Vector
    """[m] in the frame of the sensor, shape (N, 3); without those that are certainly too far away."""
    valid: int
    """Number of points or pixels that are measurements."""
    total: int
    """Number of all of them."""


class SensedWorld(SessionWorker):
    """Keeps the world of a run, with the cells of each cloud as an object of its name, and watches its age.

    Cells of the arm, of what it carries and of other objects are left out. A message that cannot be used, e.g. of a
    covered sensor, does not change the cells: they age, until the rule of the cloud applies.
    """

    def __init__(self, options: WorldOptions, session: RunView) -> None:
        self._keeper = WorldKeeper(options, session)
        topics = ", ".join(cloud.topic for cloud in options.clouds.values())
        summary = f"{self._keeper.summary}, and cells from {topics}" if topics else self._keeper.summary
        super().__init__(session, "world", summary, (CONTROL,))
        self._options = options.clouds
        self._told_ns: int | None = None

    @override
    def setup(self) -> None:
        if self._options:
            self._arm = robot_arm(self.session.config.robot)
        self._keeper.start()
        self.on_end.callback(self._keeper.stop)
        self._frames = Frames(self.session)
        self.on_end.callback(self._frames.close)
        self._clouds = {
            name: _Cloud(cloud, self.session, self._keeper.ages[name]) for name, cloud in self._options.items()
        }
        for cloud in self._clouds.values():
            self.on_end.callback(cloud.close)
        if self._clouds:
            self.session.bus.serve(CLEAR, self._clear)
            self.on_end.callback(self.session.bus.unserve, CLEAR)

    @override
    def work(self, timeout_s: float) -> None:
        if not self._clouds and timeout_s > 0:
            self.pause(min(timeout_s, _GLANCE_S))
        for name, cloud in self._clouds.items():
            received = cloud.due(timeout_s / len(self._clouds))
            self._frames.update()
            if received is not None:
                try:
                    self._take(name, cloud, received)
                except (ValueError, ContractError) as error:
                    cloud.age.refuse(error)
        self._tell(self._keeper.observed().ages)

    def _take(self, name: str, cloud: _Cloud, received: Received) -> None:
        """Replace the cells of a cloud by those of a message.

        Raises:
            ValueError: for a message that cannot be used; the cells stay.
            ContractError: as before.
        """
        measured_ns = cloud.measured_at(received)
        cells = cloud.cells(received.message, measured_ns, self._frames)
        if cells is not None:
            cells = self._unknown(cells, cloud.options.margin)
        cells = cloud.kept(cells, measured_ns)
        self._keeper.put(name, None if cells is None else WorldObject(cells), measured_ns)

    def _unknown(self, cells: Voxels, margin: float) -> Voxels | None:
        """The cells that neither the arm nor an object occupies."""
        arm, world = self._arm, self._keeper.observed().world
        q = self.session.measured().position
        arm_shapes = arm.placed_shapes(q)
        others: list[tuple[Any, Vector]] = []
        for thing in world.objects.values():
            frame = np.eye(4) if thing.link is None else arm.link_pose(thing.link, q)
            if not isinstance(thing.shape, Voxels):
                shapes = others if thing.link is None else arm_shapes
                shapes.append((geometry(thing.shape), frame @ matrix(thing.pose)))
        remaining = outside(cells, arm_shapes, margin)
        # The small margin keeps flat things that stand on an object.
        return None if remaining is None else outside(remaining, others, cells.size / 2)

    def _clear(self, request: NoRequest) -> None:
        for name, cloud in self._clouds.items():
            cloud.forget()
            self._keeper.put(name, None)

    def _tell(self, ages: Mapping[str, AgeSummary]) -> None:
        """Publish the ages on `/diagnostics`, once per second."""
        now_ns, robot = self.session.clock.now_ns(), self.session.config.robot.name
        if not ages or (self._told_ns is not None and now_ns - self._told_ns < ns(_DIAGNOSTICS_S)):
            return
        self._told_ns = now_ns
        statuses = tuple(_status(name, age, robot) for name, age in ages.items())
        self.session.bus.publish(DIAGNOSTICS, DiagnosticArray(Header(now_ns), statuses))


def _status(name: str, age: AgeSummary, robot: str) -> DiagnosticStatus:
    refuses = age.is_stale and age.when_stale == "refuse"
    level = DiagnosticStatus.ERROR if refuses else DiagnosticStatus.WARN if age.problem else DiagnosticStatus.OK
    age_s = "never" if age.age_s is None else f"{age.age_s:.2f}"
    values = {"age_s": age_s, "max_age_s": f"{age.max_age_s}", "when_stale": age.when_stale}
    values |= {f"refused {reason}": str(count) for reason, count in age.refused.items()}
    return DiagnosticStatus(
        level, f"world {name}", age.problem, robot, tuple(KeyValue(key, value) for key, value in values.items())
    )


class _Cloud:
    """One source of points.

    Attributes:
        age: its age.
        options: its options.
    """

    def __init__(self, options: CloudOptions, session: RunView, age: Age) -> None:
        self.options = options
        self.age = age
        self._log = session.log
        self._clock = session.clock
        self._info: CameraInfo | None = None
        self._info_at_ns: int | None = None
        self._due_ns: int | None = None
        self._seen: deque[tuple[int, Voxels]] = deque()
        """Time of measurement [ns] and cells of updates, oldest first."""
        self._usual: deque[int] = deque(maxlen=_USUAL)
        """Numbers of measurements of the last usable messages."""
        self._is_full = False
        bus = session.bus
        self._messages = bus.subscribe(options.topic, 1, PointCloud2, Image)
        self._infos = bus.subscribe(options.info or f"{options.topic.rpartition('/')[0]}/camera_info", 1, CameraInfo)

    def close(self) -> None:
        self._messages.close()
        self._infos.close()

    def forget(self) -> None:
        """Forget earlier cells, and how much the sensor used to measure."""
        self._seen.clear()
        self._usual.clear()

    def due(self, timeout_s: float) -> Received | None:
        """The newest message, if an update is due."""
        received = self._messages.get(timeout_s)
        if received is None or (self._due_ns is not None and received.received_ns < self._due_ns):
            return None
        self._due_ns = received.received_ns + ns(1.0 / self.options.rate)
        return received

    def measured_at(self, received: Received) -> int:
        """When a message was measured [ns].

        Raises:
            Unusable: as `Age.measured_at`.
        """
        message = received.message
        assert isinstance(message, PointCloud2 | Image)
        return self.age.measured_at(message.header.stamp_ns, received.received_ns)

    def cells(self, message: Message, measured_ns: int, frames: Frames) -> Voxels | None:
        """The cells that a message occupies in the base frame.

        Args:
            message: a cloud or a depth image.
            measured_ns: when it was measured [ns].
            frames: poses of sensors.

        Raises:
            ValueError: for a message that cannot be used, that of a covered sensor, or an unknown frame.
            ContractError: for an image that is malformed.
        """
        options = self.options
        assert isinstance(message, PointCloud2 | Image)
        seen = self._cloud(message) if isinstance(message, PointCloud2) else self._image(message)
        self._check_covered(seen)
        try:
            placed = frames.pose(options.frame or message.header.frame_id, measured_ns, options.transform_tolerance)
        except UnknownFrame as error:
            raise Unusable("unknown frame", str(error)) from error
        points = seen.points[np.linalg.norm(seen.points, axis=1) <= options.furthest]
        points = points @ placed[:3, :3].T + placed[:3, 3]
        points = points[np.linalg.norm(points, axis=1) <= options.reach]
        self._usual.append(seen.valid)
        return voxels(points, options.cell, least_points=options.least_points)

    def _check_covered(self, seen: _Seen) -> None:
        """Refuse a message with hardly any measurement: the sensor is covered or blind, the world is not empty.

        Raises:
            Unusable: for such a message.
        """
        least = self.options.least_valid
        if least == 0:
            return
        usual = max(self._usual, default=0)
        if seen.valid == 0 or seen.valid < least * seen.total:
            why = f"of its {seen.total} points or pixels {seen.valid} measure a distance"
        elif seen.valid < least * usual:
            why = f"it measures {seen.valid} points, and measured {usual} before"
        else:
            return
        raise Unusable("covered", f"the sensor seems to be covered or blind: {why} (least_valid is {least:g})")

    def _cloud(self, message: PointCloud2) -> _Seen:
        points = cloud_points(message)
        measured = points[is_measured(points)]
        return _Seen(measured, len(measured), len(points))

    def _image(self, message: Image) -> _Seen:
        options = self.options
        if message.encoding not in ("16UC1", "32FC1"):
            kind = f"{message.ros_type} {message.encoding}"
            raise ValueError(f"needs a PointCloud2, or an Image of 16UC1 or 32FC1; got {kind}")
        if message.height * message.width > MOST_POINTS:
            raise ValueError(f"the image has {message.height}x{message.width} pixels, at most {MOST_POINTS} are read")
        self._take_info()
        info = self._info
        if info is None:
            raise Unusable("no CameraInfo", f"a depth image needs the CameraInfo of its camera on {self._infos.topic}")
        if (info.height, info.width) != (message.height, message.width):
            raise Unusable(
                "another size",
                f"the image has {message.height}x{message.width} pixels, but CameraInfo says"
                f" {info.height}x{info.width}",
            )
        k = info.k.reshape(3, 3).copy()
        raw = pixels(message)[:, :, 0]
        valid = is_depth(raw)
        step = max(1, int(options.cell * k[0, 0] / (_PIXELS * options.furthest)))
        k[:2] /= step
        depth = np.where(valid, raw, 0)[::step, ::step].astype(float)
        depth /= 1000.0 if message.encoding == "16UC1" else 1.0
        return _Seen(depth_points(depth, k, options.furthest), int(valid.sum()), valid.size)

    def _take_info(self) -> None:
        """Take the newest CameraInfo; one that is malformed, in the future or older than the present one is refused.

        Raises:
            ValueError: for such a one.
        """
        received = self._infos.get()
        if received is None:
            return
        info = received.message
        assert isinstance(info, CameraInfo)
        stamp_ns = info.header.stamp_ns or received.received_ns
        age_ns = self._clock.age_ns(stamp_ns)
        if age_ns < 0 and self._clock.refusal(stamp_ns):
            raise Unusable("in the future", f"its CameraInfo is {seconds(-age_ns):.1f} s in the future; set the clocks")
        at_ns = self._clock.now_ns() - max(age_ns, 0)
        if self._info_at_ns is not None and at_ns < self._info_at_ns:
            raise Unusable("out of order", "its CameraInfo is older than the one before, by its stamp")
        if info.k.size != 9:
            raise ValueError(f"the matrix k of its CameraInfo has {info.k.size} numbers, must be 9")
        check_intrinsics(info.k.reshape(3, 3), info.height, info.width)
        self._info, self._info_at_ns = info, at_ns

    def kept(self, cells: Voxels | None, measured_ns: int) -> Voxels | None:
        """These cells and earlier ones that are still kept, at most `most_cells`."""
        options = self.options
        if options.keep == 0:
            self._seen.clear()
        while self._seen and measured_ns - self._seen[0][0] > ns(options.keep):
            self._seen.popleft()
        if cells is not None:
            self._seen.append((measured_ns, cells))
        if not self._seen:
            return None
        occupied = np.unique(np.concatenate([each.cells for _, each in self._seen]), axis=0)
        is_full, self._is_full = self._is_full, len(occupied) > options.most_cells
        if self._is_full:
            if not is_full:
                message = "%s: %d occupied cells, only the nearest %d are kept (most_cells)"
                self._log.warning(message, self.age.what, len(occupied), options.most_cells)
            occupied = occupied[np.argsort(np.linalg.norm(occupied, axis=1), kind="stable")[: options.most_cells]]
        return Voxels(options.cell, occupied)
