"""Point clouds and depth images as occupied cells of the world."""

from __future__ import annotations

from collections import deque
from types import NoneType
from typing import Any, override

import numpy as np
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import (
    CameraInfo,
    ContractError,
    Image,
    Message,
    PointCloud2,
    Pose,
    TFMessage,
    TransformStamped,
    Vector,
    ns,
    pixels,
)
from ibrobot_core.app import CONTROL, Bus, NoRequest, Received, RunView, Service, SessionWorker
from ibrobot_planning.world.arm import robot_arm
from ibrobot_planning.world.coal_shapes import geometry
from ibrobot_planning.world.objects import Voxels, WorldObject, world_of
from ibrobot_planning.world.options import CloudOptions, WorldOptions
from ibrobot_planning.world.section import WorldKeeper
from ibrobot_planning.world.voxels import cloud_points, depth_points, outside, voxels

CLEAR = Service("/clear_octomap", NoRequest, NoneType, "Remove the cells of all clouds until the next message.")
"""MoveIt's name."""
_PIXELS = 3
"""Pixels along the edge of a cell at the furthest distance; images are thinned to about this."""


class CloudKeeper(SessionWorker):
    """Keeps the world of a run, with the cells of each cloud as an object of its name.

    Cells of the arm, of what it carries and of other objects are left out.
    """

    def __init__(self, options: WorldOptions, session: RunView) -> None:
        self._keeper = WorldKeeper(options, session)
        topics = ", ".join(cloud.topic for cloud in options.clouds.values())
        super().__init__(session, "world", f"{self._keeper.summary}, and cells from {topics}", (CONTROL,))
        self._options = options.clouds

    @override
    def setup(self) -> None:
        self._arm = robot_arm(self.session.config.robot)
        self._keeper.start()
        self.on_end.callback(self._keeper.stop)
        self._frames = _Frames(self.session.bus)
        self.on_end.callback(self._frames.close)
        self._clouds = {name: _Cloud(name, cloud, self.session) for name, cloud in self._options.items()}
        for cloud in self._clouds.values():
            self.on_end.callback(cloud.close)
        self.session.bus.serve(CLEAR, self._clear)
        self.on_end.callback(self.session.bus.unserve, CLEAR)

    @override
    def work(self, timeout_s: float) -> None:
        for name, cloud in self._clouds.items():
            received = cloud.due(timeout_s / len(self._clouds))
            if received is None:
                continue
            try:
                cells = cloud.cells(received, self._frames)
                if cells is not None:
                    cells = self._unknown(cells, cloud.options.margin)
                cells = cloud.kept(cells, received.received_ns)
            except (ValueError, ContractError) as error:
                cloud.report(str(error))
                continue
            self._keeper.put(name, None if cells is None else WorldObject(cells))

    def _unknown(self, cells: Voxels, margin: float) -> Voxels | None:
        """The cells that neither the arm nor an object occupies."""
        arm, world = self._arm, world_of(self.session.bus)
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
            cloud.seen.clear()
            self._keeper.put(name, None)


class _Cloud:
    """One source of points."""

    def __init__(self, name: str, options: CloudOptions, session: RunView) -> None:
        self.options = options
        self._name = name
        self._session = session
        self._info: CameraInfo | None = None
        self._due_ns: int | None = None
        self.seen: deque[tuple[int, Voxels]] = deque()
        """Time of receipt [ns] and cells of updates, oldest first."""
        self._reported = ""
        bus = session.bus
        self._messages = bus.subscribe(options.topic, 1, PointCloud2, Image)
        self._infos = bus.subscribe(options.info or f"{options.topic.rpartition('/')[0]}/camera_info", 1, CameraInfo)

    def close(self) -> None:
        self._messages.close()
        self._infos.close()

    def due(self, timeout_s: float) -> Received | None:
        """The newest message, if an update is due."""
        received = self._messages.get(timeout_s)
        if received is None or (self._due_ns is not None and received.received_ns < self._due_ns):
            return None
        self._due_ns = received.received_ns + ns(1.0 / self.options.rate)
        return received

    def cells(self, received: Received, frames: _Frames) -> Voxels | None:
        """The cells that a message occupies in the base frame.

        Raises:
            ValueError: for a message that cannot be used, or an unknown frame.
        """
        options, message = self.options, received.message
        points = self._points(message)
        assert isinstance(message, PointCloud2 | Image)
        placed = frames.pose(options.frame or message.header.frame_id)
        points = points[np.isfinite(points).all(axis=1)]
        points = points[np.linalg.norm(points, axis=1) <= options.furthest]
        points = points @ placed[:3, :3].T + placed[:3, 3]
        points = points[np.linalg.norm(points, axis=1) <= options.reach]
        return voxels(points, options.cell, least_points=options.least_points)

    def _points(self, message: Message) -> Vector:
        """Points in the frame of the sensor."""
        options = self.options
        if isinstance(message, PointCloud2):
            return cloud_points(message)
        if not isinstance(message, Image) or message.encoding not in ("16UC1", "32FC1"):
            kind = f"{message.ros_type} {message.encoding}" if isinstance(message, Image) else message.ros_type
            raise ValueError(f"needs a PointCloud2, or an Image of 16UC1 or 32FC1; got {kind}")
        received = self._infos.get()
        if received is not None:
            assert isinstance(received.message, CameraInfo)
            self._info = received.message
        if self._info is None:
            raise ValueError(f"a depth image needs the CameraInfo of its camera on {self._infos.topic}")
        if (self._info.height, self._info.width) != (message.height, message.width):
            raise ValueError(
                f"the image has {message.height}x{message.width} pixels, but CameraInfo says"
                f" {self._info.height}x{self._info.width}"
            )
        k = self._info.k.reshape(3, 3).copy()
        depth = pixels(message)[:, :, 0].astype(float) / (1000.0 if message.encoding == "16UC1" else 1.0)
        step = max(1, int(options.cell * k[0, 0] / (_PIXELS * options.furthest)))
        k[:2] /= step
        return depth_points(depth[::step, ::step], k, options.furthest)

    def kept(self, cells: Voxels | None, now_ns: int) -> Voxels | None:
        """These cells and earlier ones that are still kept, at most `most_cells`."""
        options = self.options
        if options.keep == 0:
            self.seen.clear()
        while self.seen and now_ns - self.seen[0][0] > ns(options.keep):
            self.seen.popleft()
        if cells is not None:
            self.seen.append((now_ns, cells))
        if not self.seen:
            return None
        occupied = np.unique(np.concatenate([each.cells for _, each in self.seen]), axis=0)
        if len(occupied) > options.most_cells:
            self.report(f"{len(occupied)} occupied cells, only the nearest {options.most_cells} are kept (most_cells)")
            occupied = occupied[np.argsort(np.linalg.norm(occupied, axis=1), kind="stable")[: options.most_cells]]
        return Voxels(options.cell, occupied)

    def report(self, message: str) -> None:
        """Log a warning, unless it is the same as before."""
        if message != self._reported:
            self._reported = message
            self._session.log.warning("world.clouds.%s: %s: %s", self._name, self.options.topic, message)


class _Frames:
    """Poses of sensors in the base frame, from `/tf` and `/tf_static`."""

    def __init__(self, bus: Bus) -> None:
        self._subscriptions = [bus.subscribe(topic, 10, TFMessage) for topic in ("/tf_static", "/tf")]
        self._newest: dict[str, TransformStamped] = {}

    def pose(self, frame: str) -> Vector:
        """Pose of a frame in the frame at the root of its tree, shape (4, 4).

        Raises:
            ValueError: for an unknown frame.
        """
        for subscription in self._subscriptions:
            for received in subscription.drain():
                message = received.message
                assert isinstance(message, TFMessage)
                self._newest.update((each.child_frame_id, each) for each in message.transforms)
        if frame not in self._newest:
            raise ValueError(
                f"no transform of frame {frame!r}; peripherals[].transform says where a camera is mounted;"
                f" known frames: {', '.join(self._newest) or 'none'}"
            )
        placed = np.eye(4)
        for _ in self._newest:
            if frame not in self._newest:
                break
            transform = self._newest[frame]
            placed = matrix(Pose(transform.translation, transform.rotation)) @ placed
            frame = transform.header.frame_id
        return placed

    def close(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            subscription.close()
