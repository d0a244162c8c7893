"""A camera in the simulated scene: renders the newest physics state on the bus, at its rate in simulated time."""

from __future__ import annotations

import math
import time
from typing import override

import mujoco
import numpy as np
from ibrobot_kinematics.poses import orientation
from ibrobot_kinematics.urdf import read_urdf
from ibrobot_ros2.jpeg import to_jpeg
from numpy.typing import NDArray

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Context,
    Header,
    Image,
    Message,
    Sensor,
    SensorError,
    SteppedClock,
    TFMessage,
    TransformStamped,
    Vector3,
    ns,
)
from ibrobot_core.app import Subscription
from ibrobot_mujoco.options import CameraOptions, MujocoOptions
from ibrobot_mujoco.render import Renderer
from ibrobot_mujoco.state import PHYSICS_TOPIC, DrawnWorld, newest, stamp_of

# One second of states at 100 Hz; states that arrive during rendering are skipped, not lost from the queue.
_QUEUE = 100
_FURTHEST_M = 10.0
"""Depth beyond this counts as missing, as with real cameras."""
_OPTICAL = np.diag([1.0, -1.0, -1.0])
"""An optical frame (x right, y down, z ahead) in MuJoCo's frame of a camera (x right, y up, looks along -z)."""


class MujocoCamera(Sensor):
    """Renders in the thread of `open` and `read`. Images that are due too soon are counted and skipped.

    In lockstep, only pictures that have a receiver are rendered; rendering starts with the first of them. With each
    picture comes the camera's pose on `/tf`, if anybody listens, unless the robot YAML has its `transform`.
    """

    def __init__(self, options: CameraOptions, ctx: Context) -> None:
        self._is_depth = options.stream == "depth"
        self.message_type = CompressedImage if options.encoding == "jpeg" and not self._is_depth else Image
        self.topic = f"/camera/{ctx.name}/image_raw"
        self.skipped = 0
        """Number of images that were due but not rendered."""
        self._options = options
        self._ctx = ctx
        self._period_ns = ns(1.0 / options.fps)
        self._lockstep = isinstance(ctx.clock, SteppedClock)
        self._last_slot: int | None = None
        self._renderer: Renderer | None = None
        self._states: Subscription | None = None

    @override
    def open(self) -> None:
        simulation, bus = self._ctx.simulation, self._ctx.bus
        if not isinstance(simulation, MujocoOptions) or bus is None:
            raise SensorError(f"camera {self._ctx.name!r}: type mujoco needs a running simulation: {{type: mujoco}}")
        self._drawn = DrawnWorld.of(simulation, self._ctx.robot)
        self._model = self._drawn.model
        self._camera = find_camera(self._model, self._options, self._ctx.name)
        self._fovy = math.radians(self._model.cam_fovy[self._camera])
        self._last_slot = None
        urdf = self._ctx.robot.description.urdf
        self._base = read_urdf(urdf).root if urdf is not None else "base_link"
        session = self._ctx.session
        self._is_placed = session is not None and session.config.peripherals[self._ctx.name].transform is not None
        self._states = bus.subscribe(PHYSICS_TOPIC, _QUEUE)
        if not self._is_idle():
            self._rendering()

    def _is_idle(self) -> bool:
        """Whether nobody would receive a picture of a simulation that waits for nobody."""
        bus = self._ctx.bus
        self.idle = self._lockstep and not (bus is not None and bus.has_subscribers(self.topic))
        return self.idle

    def _rendering(self) -> Renderer:
        if self._renderer is None:
            size = self._options.width, self._options.height
            self._renderer = Renderer(self._model, self._camera, *size, shadows=self._options.shadows)
            self._ctx.log.info("camera %s renders with %s", self._ctx.name, self._renderer.backend)
        return self._renderer

    @override
    def read(self, timeout_s: float) -> Image | CompressedImage | None:
        if self._states is None:
            raise SensorError(f"camera {self._ctx.name!r} is not open")
        deadline = time.monotonic() + timeout_s
        while True:
            state = newest(self._states, max(0.0, deadline - time.monotonic()) if timeout_s > 0 else 0.0)
            if state is None:
                return None
            stamp_ns = stamp_of(state)
            if self._is_due(stamp_ns) and not self._is_idle():
                renderer = self._rendering()
                self._drawn.follow(state)
                self._publish_pose(stamp_ns)
                if self._is_depth:
                    return self._depth_image(stamp_ns, renderer.render_depth(self._drawn.data))
                return self._image(stamp_ns, renderer.render(self._drawn.data))
            if timeout_s <= 0:
                return None

    def _is_due(self, stamp_ns: int) -> bool:
        """Whether a state is the first one in its period of the camera; periods begin at stamp 0."""
        slot, last = stamp_ns // self._period_ns, self._last_slot
        if last is not None and slot <= last:
            return False
        self.skipped += 0 if last is None else slot - last - 1
        self._last_slot = slot
        return True

    def _image(self, stamp_ns: int, pixels: np.ndarray) -> Image | CompressedImage:
        height, width, _ = pixels.shape
        image = Image(self._header(stamp_ns), height, width, "rgb8", 3 * width, pixels.reshape(-1))
        return to_jpeg(image, self._options.jpeg_quality) if self.message_type is CompressedImage else image

    def _depth_image(self, stamp_ns: int, depth: NDArray[np.float32]) -> Image:
        height, width = depth.shape
        millimetres = np.where(depth < _FURTHEST_M, depth * 1000.0 + 0.5, 0.0).astype("<u2")
        return Image(self._header(stamp_ns), height, width, "16UC1", 2 * width, millimetres.reshape(-1).view(np.uint8))

    def _publish_pose(self, stamp_ns: int) -> None:
        """Publish where the camera is, which only a simulation knows without measuring it."""
        bus, scene = self._ctx.bus, self._drawn.data
        if bus is None or self._is_placed or not bus.has_subscribers("/tf"):
            return
        turn = scene.cam_xmat[self._camera].reshape(3, 3) @ _OPTICAL
        base, frame = Header(stamp_ns, self._base), self._header(stamp_ns).frame_id
        placed = TransformStamped(base, frame, Vector3(*scene.cam_xpos[self._camera].tolist()), orientation(turn))
        bus.publish("/tf", TFMessage((placed,)))

    def _header(self, stamp_ns: int) -> Header:
        return Header(stamp_ns, f"{self._ctx.name}_optical_frame")

    @override
    def close(self) -> None:
        if self._states is not None:
            self._states.close()
            self._states = None
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    @override
    def latched(self) -> tuple[tuple[str, Message], ...]:
        width, height = self._options.width, self._options.height
        focal = height / 2 / math.tan(self._fovy / 2)
        centre_x, centre_y = (width - 1) / 2, (height - 1) / 2
        k = np.array([[focal, 0, centre_x], [0, focal, centre_y], [0, 0, 1]])
        info = CameraInfo(
            self._header(self._ctx.clock.now_ns()), height, width, d=np.zeros(5), k=k.ravel(), r=np.eye(3).ravel(),
            p=np.hstack([k, np.zeros((3, 1))]).ravel(),
        )  # fmt: skip
        return ((f"/camera/{self._ctx.name}/camera_info", info),)


def find_camera(model: mujoco.MjModel, options: CameraOptions, peripheral: str) -> int:
    """The number in the model of a peripheral's camera: by `camera`, or by the name, with or without `_cam`.

    Raises:
        SensorError: if it has none.
    """
    names = (options.camera,) if options.camera is not None else (peripheral, f"{peripheral}_cam")
    for name in names:
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if number >= 0:
            return int(number)
    there = ", ".join(model.camera(i).name for i in range(model.ncam))
    raise SensorError(f"camera {peripheral!r}: no {' or '.join(names)} in the scene; its cameras are: {there}")
