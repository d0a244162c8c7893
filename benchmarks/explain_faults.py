"""Faults that `explain.py` plants in a simulated run: on the robot's side, below everything that a recording sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import attrs
import cv2
import numpy as np
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_mujoco import camera
from ibrobot_mujoco.camera import MujocoCamera
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import CameraOptions
from mujoco import MjModel
from numpy.typing import NDArray

from ibrobot_core.errors import PolicyError
from ibrobot_core.inference.client import Chunk, DispatchInfer, LockstepClient
from ibrobot_core.launch.sources.policy import PolicySource

type Array = NDArray[Any]

PAN, LIFT, ELBOW, GRIPPER = 0, 1, 2, 5
EARLY = (240, 120, 40)
"""Steps after which trainings were stopped: 1.4, 0.7 and 0.2 times through the data."""
BLIND = (100, 1000, 1_000_000)
"""Times by which the statistics of a policy's pictures of `top` are too wide: all pictures look grey to it."""
DIFFUSED = (
    "observation_late", "answers_slow", "plan_dry", "requests_fail", "other_prompt", "joint_order", "gripper_reversed",
    "other_units",
)  # fmt: skip
"""Faults that a Diffusion policy has, too."""
REST = np.array([0, -1.57, 1.57, 0.79, 0, 0])


@attrs.frozen
class Fault:
    """A fault in three strengths."""

    plant: Callable[..., None]
    """Plants it in this process."""
    strengths: tuple[Any, Any, Any]
    """Arguments of `plant`: mild, medium, strong."""
    policy: str = "state"
    """The policy that acts: `state`, `pictures`, `diffusion` or `scripted`; with braces, one for each strength."""
    trained: bool = False
    """Whether the card of the training is at hand, and not only one of the data."""
    asked: bool = False
    """Whether the model is asked again."""
    options: Callable[[Any], tuple[str, ...]] = lambda strength: ()
    """Words of the command line."""


def nothing(strength: object) -> None:
    """Plant nothing: the command line does."""


def seen(change: Callable[[Array, str], Array]) -> None:
    """Change what the cameras deliver."""
    plain = MujocoCamera._image

    def image(self: MujocoCamera, stamp_ns: int, pixels: Array) -> Any:
        changed = np.clip(change(pixels.astype(np.float32), self._ctx.name), 0, 255).astype(np.uint8)
        return plain(self, stamp_ns, np.ascontiguousarray(changed))

    MujocoCamera._image = image  # type: ignore[method-assign]


def of_top(change: Callable[[Array], Array]) -> None:
    """Change what one camera delivers."""
    seen(lambda pixels, name: change(pixels) if name == "top" else pixels)


def scaled(factors: tuple[float, ...]) -> None:
    """Brightness, or colours."""
    of_top(lambda pixels: pixels * np.array(factors, np.float32))


def blurred(width: float) -> None:
    """Out of focus."""
    of_top(lambda pixels: cv2.GaussianBlur(pixels, (0, 0), width))


def covered(share: float) -> None:
    """Something before the lens."""

    def change(pixels: Array) -> Array:
        pixels[:, : int(share * pixels.shape[1])] = (60, 50, 45)
        return pixels

    of_top(change)


def frozen(seconds: float) -> None:
    """Pictures that stop for a time, 1 s after the beginning."""
    last: list[Array] = []
    count = [0]

    def change(pixels: Array) -> Array:
        count[0] += 1
        if not last or not 15 <= count[0] < 15 * (1 + seconds):
            last[:] = [pixels]
        return last[0].copy()

    of_top(change)


def moved(by: tuple[float, float]) -> None:
    """A camera that was pushed and turned: [m] and [rad]."""
    plain = camera.find_camera

    def find(model: MjModel, options: CameraOptions, peripheral: str) -> int:
        number = plain(model, options, peripheral)
        if peripheral == "top":
            w, x, y, z = model.cam_quat[number]
            half = by[1] / 2
            c, s = np.cos(half), np.sin(half)  # a turn about the optical axis
            model.cam_quat[number] = (w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s)
            model.cam_pos[number] += (by[0], by[0] / 2, 0.0)
        return number

    camera.find_camera = find


def exchanged(strength: object) -> None:
    """Each camera has the other's place."""
    plain = camera.find_camera

    def find(model: MjModel, options: CameraOptions, peripheral: str) -> int:
        return plain(model, options, {"top": "wrist", "wrist": "top"}[peripheral])

    camera.find_camera = find


def late(seconds: float) -> None:
    """Joint positions arrive late, with the stamp of their measurement."""
    plain = MujocoHardware.read
    waiting: list[Any] = []

    def read(self: MujocoHardware) -> Any:
        waiting.append(plain(self))
        return waiting.pop(0) if len(waiting) > round(100 * seconds) else waiting[0]

    MujocoHardware.read = read  # type: ignore[method-assign]


def reported(of: Callable[[Array], Array], back: Callable[[Array], Array]) -> None:
    """Change what the arm says of its positions, and what it understands of commands."""
    read, write = MujocoHardware.read, MujocoHardware.write

    def new_read(self: MujocoHardware) -> Any:
        reading = read(self)
        return attrs.evolve(reading, position=of(reading.position.copy()))

    MujocoHardware.read = new_read  # type: ignore[method-assign]
    MujocoHardware.write = lambda self, position: write(self, back(position.copy()))  # type: ignore[method-assign]


def zero(shift: float) -> None:
    """The calibration of another arm."""
    off = np.zeros(6)
    off[PAN] = shift
    reported(lambda position: position + off, lambda position: position - off)


def units(of: str) -> None:
    """A driver that is written for another unit."""
    widths = np.array([3.84, 3.49, 3.38, 3.32, 5.48, 1.92])
    factor: Array = 200 / widths if of == "percent" else np.full(6, 180 / np.pi)
    reported(lambda position: factor * position, lambda position: position / factor)


def order(pair: tuple[int, int]) -> None:
    """Two motors with each other's number."""
    places = list(range(6))
    places[pair[0]], places[pair[1]] = places[pair[1]], places[pair[0]]
    reported(lambda position: position[places], lambda position: position[places])


def _gripper(change: Callable[[float], float], back: Callable[[float], float]) -> None:
    def of(position: Array, function: Callable[[float], float]) -> Array:
        position[GRIPPER] = function(position[GRIPPER])
        return position

    reported(lambda position: of(position, change), lambda position: of(position, back))


def gripper_reversed(strength: object) -> None:
    """Open is shut."""
    _gripper(lambda angle: 1.57 - angle, lambda angle: 1.57 - angle)


def gripper_scaled(factor: float) -> None:
    """A jaw of another range."""
    _gripper(lambda angle: factor * angle, lambda angle: angle)


def weak(share: float) -> None:
    """A joint that follows a part of its commands."""

    def back(position: Array) -> Array:
        position[PAN] *= share
        position[LIFT] = REST[LIFT] + share * (position[LIFT] - REST[LIFT])
        return position

    reported(lambda position: position, back)


def answered(change: Callable[[Array, int], Array]) -> None:
    """Change what the model answers; its requests are counted from 0."""
    plain = LeRobotPolicy.postprocess
    count = [-1]

    def postprocess(self: LeRobotPolicy, tensors: Any) -> Array:
        count[0] += 1
        return change(plain(self, tensors), count[0])

    LeRobotPolicy.postprocess = postprocess  # type: ignore[method-assign]


def statistics(factor: float) -> None:
    """The statistics of another dataset."""
    answered(lambda actions, number: factor * actions + 0.25 * factor)


def torn(apart: float) -> None:
    """Answers that intend one way and the other in turn."""

    def change(actions: Array, number: int) -> Array:
        actions[:, PAN] += (apart if number % 2 else -apart) / 2
        actions[:, LIFT] += (apart if number % 2 else -apart) / 3
        return actions

    answered(change)


def fast(factor: float) -> None:
    """Chunks of data that was sampled at another rate."""

    def change(actions: Array, number: int) -> Array:
        at = np.minimum(np.arange(len(actions)) * factor, len(actions) - 1)
        columns = [np.interp(at, np.arange(len(actions)), column) for column in actions.T]
        return np.stack(columns, axis=1)

    answered(change)


def still(requests: int) -> None:
    """A model that waits at the beginning."""
    answered(lambda actions, number: np.repeat(REST[None], len(actions), 0) if number < requests else actions)


def failing(share: float) -> None:
    """Requests that fail."""
    plain = LeRobotPolicy.infer
    rng = np.random.default_rng(0)

    def infer(self: LeRobotPolicy, tensors: Any) -> Any:
        if rng.uniform() < share:
            raise PolicyError("CUDA error: out of memory")
        return plain(self, tensors)

    LeRobotPolicy.infer = infer  # type: ignore[method-assign]


def slow(seconds: float) -> None:
    """Answers that take simulated time."""
    setup = PolicySource.setup

    class Late(LockstepClient):
        clock: Any = None
        due_ns = 0

        def submit(self, request: DispatchInfer) -> None:
            super().submit(request)
            self.due_ns = self.clock.now_ns() + round(seconds * 1e9)

        def poll(self, timeout_s: float = 0.0) -> Chunk | None:
            return super().poll() if self.clock.now_ns() >= self.due_ns else None

    def new_setup(self: PolicySource) -> None:
        setup(self)
        client = Late(self._model.policy, self._model.engine)
        client.clock = self.session.clock
        self._client = self._dispatcher._client = client

    PolicySource.setup = new_setup  # type: ignore[method-assign]


def never_judged(strength: object) -> None:
    """A judge that does not see a success."""
    MujocoHardware.success = lambda self: None  # type: ignore[method-assign]


def _set(pattern: str) -> Callable[[Any], tuple[str, ...]]:
    return lambda strength: ("--set", pattern.format(strength))


_DRY = ("--set", "control_modes.learned.dispatch.watermark=0")

FAULTS: Mapping[str, Fault] = {
    "observation_late": Fault(late, (0.07, 0.1, 0.15)),
    "answers_slow": Fault(slow, (0.5, 0.7, 2.5)),
    "plan_dry": Fault(slow, (0.1, 0.15, 0.25), options=lambda strength: _DRY),
    "requests_fail": Fault(failing, (0.2, 0.4, 0.7)),
    "limits_low": Fault(nothing, (0.6, 0.4, 0.2), options=lambda strength: ("velocity", str(strength))),
    "arm_not_following": Fault(weak, (0.8, 0.6, 0.2)),
    "smoothing_averages": Fault(torn, (0.2, 0.35, 0.6)),
    "stands_still": Fault(still, (6, 12, 200)),
    "other_speed": Fault(fast, (1.7, 2.2, 3.0)),
    "statistics": Fault(statistics, (1.6, 2.2, 3.0)),
    "other_prompt": Fault(
        nothing,
        ("Put the cube in the bin", "put the ball into the bin", "wipe the table"),
        options=_set("control_modes.learned.inference.prompt={}"),
    ),
    "unseen_start": Fault(
        nothing, (0.3, 0.5, 0.9),
        options=lambda turn: (
            "--set", f"robot.description.poses.odd=[{turn}, -1.57, 1.57, 0.79, 0, 0]",
            "--set", "simulation.start_pose=odd",
        ),
    ),
    "joint_order": Fault(order, ((LIFT, ELBOW), (PAN, ELBOW), (PAN, LIFT))),
    "gripper_reversed": Fault(gripper_reversed, (1, 1, 1)),
    "gripper_scaled": Fault(gripper_scaled, (1.8, 2.5, 3.5)),
    "joint_zero": Fault(zero, (0.2, 0.3, 0.45), "pictures"),
    "other_units": Fault(units, ("percent", "degrees", "degrees")),
    "checkpoint_early": Fault(nothing, EARLY, "early-{}", trained=True),
    "unseen_success": Fault(never_judged, (1, 1, 1), "scripted"),
    "picture_dark": Fault(scaled, ((0.65,), (0.5,), (0.25,)), "pictures"),
    "picture_bright": Fault(scaled, ((1.4,), (1.6,), (1.9,)), "pictures"),
    "picture_blurred": Fault(blurred, (1.2, 2.0, 4.0), "pictures"),
    "picture_covered": Fault(covered, (0.4, 0.6, 1.0), "pictures"),
    "picture_frozen": Fault(frozen, (1.2, 2.0, 4.0), "pictures"),
    "white_balance": Fault(scaled, ((1.15, 1, 0.9), (1.3, 1, 0.8), (1.5, 1, 0.6)), "pictures"),
    "bgr": Fault(lambda strength: of_top(lambda pixels: pixels[..., ::-1]), (1, 1, 1), "pictures"),
    "picture_flipped": Fault(lambda strength: of_top(lambda pixels: pixels[::-1, ::-1]), (1, 1, 1), "pictures"),
    "cameras_exchanged": Fault(exchanged, (1, 1, 1), "pictures"),
    "camera_moved": Fault(moved, ((0.02, 0.0), (0.04, 0.05), (0.08, 0.15)), "pictures"),
    "camera_ignored": Fault(nothing, BLIND, "blind-{}", asked=True),
}  # fmt: skip
"""Cause -> the fault that it explains."""
