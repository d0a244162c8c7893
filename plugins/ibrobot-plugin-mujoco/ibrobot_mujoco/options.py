"""Options of the simulation and its cameras; listing plugins does not import MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import attrs

from ibrobot_core.api import Late, OptionFault, Options, documented, option
from ibrobot_mujoco.gl import from_module
from ibrobot_mujoco.scene import SceneConfig
from ibrobot_mujoco.scenes import scene

if TYPE_CHECKING:
    from ibrobot_core.api import Robot, SceneObject

Vec3 = tuple[float, float, float]
_OF_ALL_JOINTS = ("kp", "kv", "damping", "frictionloss", "armature", "torque_limit")
"""Options of all joints, which a file of parameters has for each joint."""


@documented
@attrs.frozen
class SceneCamera:
    """A camera added to the scene. Without `parent` it is fixed in the robot's base frame."""

    name: str = option(help="name for a peripheral's `camera`")
    pos: Vec3 = option(unit="m", help="position, in the parent's frame")
    lookat: Vec3 = option(unit="m", help="point that it looks at, in the parent's frame")
    fovy: float = option(45.0, unit="deg", gt=0, lt=180, help="vertical field of view")
    parent: str = option("world", help="MJCF body to which it is attached")

    def __attrs_post_init__(self) -> None:
        if self.pos == self.lookat:
            raise ValueError(f"lookat must differ from pos, both are {list(self.pos)}")


@documented
@attrs.frozen
class Fault:
    """A fault to inject, at a time counted from the beginning of each episode."""

    at: float = option(unit="s", ge=0, help="start time")
    kind: str = option(
        choices=("silent", "freeze_joint", "read_error"),
        help="silent: no replies, readings go stale and commands are lost; freeze_joint: one servo ignores commands; "
        "read_error: reading raises",
    )
    joint: str | None = option(None, help="joint, for freeze_joint")
    duration: float | None = option(None, unit="s", gt=0, help="duration; None: until faults are reset")

    def __attrs_post_init__(self) -> None:
        if (self.kind == "freeze_joint") != (self.joint is not None):
            need = "needs" if self.kind == "freeze_joint" else "takes no"
            raise ValueError(f"a fault of kind {self.kind} {need} joint")


@documented
@attrs.frozen
class SceneThing:
    """An object added to the scene."""

    shape: Literal["box", "sphere", "cylinder"] = option(help="a box, a sphere, or a cylinder along z")
    position: Vec3 = option(unit="m", help="its centre at the beginning of each episode, in the base frame")
    size: Vec3 | None = option(None, unit="m", help="lengths of a box along x, y and z")
    radius: float | None = option(None, unit="m", gt=0, le=1, help="of a sphere or cylinder")
    height: float | None = option(None, unit="m", gt=0, le=1, help="of a cylinder")
    yaw: float = option(0.0, unit="rad", help="its turn about z")
    mass: float | None = option(None, unit="kg", gt=0, help="None: it stands still, whatever pushes it")

    def __attrs_post_init__(self) -> None:
        needed = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "height")}[self.shape]
        for key, value in (("size", self.size), ("radius", self.radius), ("height", self.height)):
            if (value is None) == (key in needed):
                state = "missing" if value is None else "given"
                raise ValueError(f"a {self.shape} takes {' and '.join(needed)}; {key} is {state}")
        if self.size is not None and min(self.size) <= 0:
            raise ValueError(f"size is {list(self.size)}, must be three lengths above 0")


@documented
@attrs.frozen
class MujocoOptions(Options):
    """Options of the simulation. Servo values of None use those of the MJCF."""

    scene: SceneConfig = option(factory=scene, help="type of scene, or a mapping with type and its options")
    timestep: float = option(0.002, unit="s", ge=1e-4, le=0.02, help="step of the physics")
    start_pose: str = option("rest", help="named pose of the robot at the beginning of an episode")

    parameters: Path | None = option(
        None,
        help="how servos and joints behave: a file of `ibrobot identify`, or the published values of the SO-101's "
        "servos, package://ibrobot_mujoco/servos/so101_sts3215.yaml; None: as in the MJCF",
    )
    kp: float | None = option(None, unit="Nm/rad", gt=0, help="position gain of the servos")
    kv: float | None = option(None, unit="Nm s/rad", ge=0, help="velocity gain of the servos")
    damping: float | None = option(None, unit="Nm s/rad", ge=0, help="viscous friction of the joints")
    frictionloss: float | None = option(None, unit="Nm", ge=0, help="dry friction of the joints")
    armature: float | None = option(None, unit="kg m^2", ge=0, help="rotor inertia seen by the joints")
    torque_limit: float | None = option(None, unit="Nm", gt=0, help="maximum torque of every servo")
    velocity_limit: float = option(4.7, unit="rad/s", gt=0, help="maximum speed of the servos' internal setpoint")

    latency: float = option(0.0, unit="s", ge=0, le=1, help="delay of commands, and of readings")
    noise: float = option(0.0, unit="rad", ge=0, help="standard deviation of the measured positions")
    faults: tuple[Fault, ...] = option((), help="faults to inject")

    objects: Mapping[str, SceneThing] = option(factory=dict, help="further objects, e.g. obstacles, by name")
    cameras: tuple[SceneCamera, ...] = option((), help="cameras in addition to `top`, `front` and those of the MJCF")

    def __attrs_post_init__(self) -> None:
        both = [name for name in _OF_ALL_JOINTS if getattr(self, name) is not None]
        if self.parameters is not None and both:
            raise ValueError(f"parameters and {both[0]} exclude each other: the file has it for each joint")

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check them against the robot and its MJCF."""
        yield from Late("ibrobot_mujoco.check:check_world")(self, robot)

    def scene_objects(self, robot: Robot) -> Sequence[SceneObject]:
        """The objects around the robot."""
        objects: Sequence[SceneObject] = from_module("scene_objects", "scene_objects")(self, robot)
        return objects


@documented
@attrs.frozen
class CameraOptions(Options):
    """Options of a simulated camera."""

    camera: str | None = option(
        None, help="camera in the scene; None: the one with the peripheral's name (or NAME_cam)"
    )
    width: int = option(640, unit="px", ge=1, le=8192, help="width of the image")
    height: int = option(480, unit="px", ge=1, le=8192, help="height of the image")
    fps: float = option(30.0, unit="Hz", gt=0, le=1000, help="images per second of simulated time")
    stream: str = option("color", choices=("color", "depth"), help="depth: 16UC1 [mm], 0 where nothing is near")
    encoding: str = option(
        "jpeg", choices=("jpeg", "raw"), help="encoding of colour messages; raw is 15 times the size of jpeg"
    )
    jpeg_quality: int = option(90, ge=1, le=100, help="JPEG quality")
    shadows: bool = option(False, help="whether to render shadows (three times the cost)")

    @property
    def picture(self) -> tuple[int, int]:
        """Height and width of the images [px]."""
        return self.height, self.width

    @property
    def lens(self) -> Mapping[str, Any]:
        """A pinhole: a simulated camera has no distortion. Its focal length, which the scene knows, changes nothing."""
        same = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
        p = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
        size = {"width": self.width, "height": self.height}
        return {**size, "distortion_model": "plumb_bob", "d": [], "k": same, "r": same, "p": p}
