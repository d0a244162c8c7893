"""The robot YAML as frozen attrs classes: keys of each section with types, units, defaults, ranges and descriptions.

Loading, `config show`, the JSON Schema and the reference pages derive from these classes, beginning with `RobotConfig`.
"""

from __future__ import annotations

import math
import types
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import attrs

from ibrobot_core.component_config import ComponentConfig, NamedComponentConfig
from ibrobot_core.deadman import Deadman
from ibrobot_core.errors import PluginNotInstalled
from ibrobot_core.messages import Image
from ibrobot_core.options import documented, fields, not_a_key, option
from ibrobot_core.robot import Robot
from ibrobot_core.units import NORM_MODES

_CAMERA_TOPIC = "/camera/{name}/image_raw"
_UNIT = 1e-3
"""Tolerance for the length of a quaternion, which may be rounded."""


@attrs.frozen
class HardwareConfig(NamedComponentConfig):
    """Hardware, and the joints that it owns."""

    plugin_kind = "hardware"
    may_be_alone = True

    joints: tuple[str, ...] = option((), help="its joints; a single component may omit them and owns all")


@attrs.frozen
class SimulationConfig(ComponentConfig):
    """The simulation, used with `--sim` or without a hardware section."""

    plugin_kind = "hardware"
    simulates = True

    default_control_mode: str | None = option(None, help="with --sim, in place of the file's default_control_mode")


@documented
@attrs.frozen
class Mount:
    """The mounting of a sensor: its frame relative to a parent frame."""

    parent: str = option(help="parent frame: a link of the URDF, or the frame of another mount")
    xyz: tuple[float, float, float] = option((0.0, 0.0, 0.0), unit="m", help="its origin in the parent frame")
    rpy: tuple[float, float, float] | None = option(
        None, unit="rad", help="roll, pitch and yaw about the fixed axes of the parent frame, as in a URDF"
    )
    quaternion: tuple[float, float, float, float] | None = option(None, help="x, y, z, w, in place of rpy")
    frame: str = option("", help="name of the frame; NAME_frame if empty. A camera looks along its x axis")

    def __attrs_post_init__(self) -> None:
        if self.rpy is not None and self.quaternion is not None:
            raise ValueError("rpy and quaternion exclude each other; give one of them")
        if not all(map(math.isfinite, (*self.xyz, *(self.rpy or ()), *(self.quaternion or ())))):
            raise ValueError("xyz, rpy and quaternion must be finite numbers")
        if self.quaternion is not None and abs(math.hypot(*self.quaternion) - 1) > _UNIT:
            raise ValueError(f"quaternion has length {math.hypot(*self.quaternion):.4g}, must have 1")


@attrs.frozen
class PeripheralConfig(ComponentConfig):
    """A sensor. `--sim` replaces it by the simulation's sensor of the same kind."""

    plugin_kind = "sensor"

    name: str = option(help="name used in the contract")
    kind: str = option(help="camera, imu, …")
    transform: Mount | None = option(None, help="where it is mounted")
    sim: Mapping[str, Any] = option(factory=dict, help="further options for the simulated sensor")
    topic: str = not_a_key(attrs.Factory(lambda self: _CAMERA_TOPIC if self.kind == "camera" else "", takes_self=True))
    """Topic of its messages, with `{name}` for its name; empty if only its options say it."""
    message: str = not_a_key(Image.ros_type)
    """ROS type of its messages."""

    @property
    def published(self) -> str:
        """The topic of its messages; empty if only its options say it."""
        return self.topic.format(name=self.name)


@attrs.frozen
class ExecutorConfig(NamedComponentConfig):
    """An executor, which moves the joints of a group."""

    plugin_kind = "executor"

    group: str = option(help="joint group that it moves")
    joints: tuple[str, ...] = not_a_key(())
    """The joints of its group, in group order."""
    goals: str = not_a_key("trajectory")
    """Kind of goals that it takes; empty if it streams."""


@attrs.frozen
class TeleopConfig(NamedComponentConfig):
    """A teleoperation device."""

    plugin_kind = "teleop"


@attrs.frozen
class PlannerConfig(ComponentConfig):
    """The planner of a mode."""

    plugin_kind = "planner"


@attrs.frozen
class GuardConfig(ComponentConfig):
    """The guard, which stops commands that would lead to a collision."""

    plugin_kind = "guard"


@attrs.frozen
class ViewerConfig(ComponentConfig):
    """A display of the robot."""

    plugin_kind = "viewer"


@attrs.frozen
class TerminalConfig(ComponentConfig):
    """What reads keys and shows runs."""

    plugin_kind = "terminal"


@documented
@attrs.frozen
class Align:
    """How samples become a value at tick t; only samples with stamp <= t count."""

    strategy: str = option(
        "hold",
        choices=("hold", "asof", "drop"),
        help="hold: the newest if at most contract.max_age old; asof: the newest if at most tol_ms old; "
        "drop: the newest if within the last step",
    )
    stamp: str = option("header", choices=("header", "receive"), help="stamp to use: of the header, or of receipt")
    tol_ms: float | None = option(None, unit="ms", ge=0, help="maximum age, for asof")

    def __attrs_post_init__(self) -> None:
        if self.strategy == "asof" and self.tol_ms is None:
            raise ValueError("strategy asof needs tol_ms, e.g. tol_ms: 100")
        if self.strategy != "asof" and self.tol_ms is not None:
            raise ValueError(f"tol_ms applies only to strategy asof, not {self.strategy}")


_LARGEST_PX = 8192


def _check_size(instance: Any, attribute: attrs.Attribute[Any], value: tuple[int, int] | None) -> None:
    if value is not None and not all(1 <= size <= _LARGEST_PX for size in value):
        raise ValueError(f"{list(value)} is not a valid size: [height, width] of 1 to {_LARGEST_PX} px each")


@documented
@attrs.frozen
class ImageSpec:
    """Conversion of an image to an array."""

    resize: tuple[int, int] | None = option(
        None, unit="px", validator=_check_size, help="[height, width]; None keeps the camera's size"
    )
    encoding: str = option("rgb8", choices=("rgb8", "bgr8", "mono8", "16UC1", "32FC1"), help="encoding of the array")
    rectify: bool = option(False, help="remove the distortion of the lens, whose intrinsics the peripheral has")


@documented
@attrs.frozen
class ObservationSpec:
    """One topic that feeds one key of the observations. Several under one key concatenate in file order."""

    key: str = option(help="e.g. observation.state, observation.images.top")
    topic: str = option("", help="topic of the messages; by default that of the peripheral")
    type: str = option("", help="ROS 2 message type; optional for /joint_states and peripherals")
    foreign: bool = option(False, help="whether only foreign bags have this type; each bag contains its definition")
    peripheral: str | None = option(None, help="peripheral that publishes the messages")
    select: tuple[str, ...] = option((), help="dotted paths into the message, e.g. position.shoulder_pan")
    image: ImageSpec | None = option(None, help="conversion of images")
    align: Align = option(factory=Align, help="how samples become a value at a tick")


@documented
@attrs.frozen
class ActionSpec:
    """One part of the action vector, for one executor. Several under one key split it in file order."""

    executor: str = option(help="executor that follows it")
    topic: str = option(help="topic for the commands after the safety layer")
    key: str = option("action", choices=("action",), help="the key of the action vector, as in datasets")
    type: str = option("std_msgs/msg/Float64MultiArray", help="message type; others need foreign")
    foreign: bool = option(False, help="whether the commands come from foreign bags, not from this robot")
    select: tuple[str, ...] = option((), help="with foreign: paths to the numbers, one per joint")
    safety_behavior: str = option("hold", choices=("hold", "relax"), help="behaviour for stale setpoints")
    align: str = option(
        "hold",
        choices=("hold", "next"),
        help="the action of a row in a dataset: hold takes the command in effect at the tick, next the first after it",
    )
    max_age: float | None = option(
        None, unit="s", gt=0, help="how long a command counts in a dataset without a newer one; None: contract.max_age"
    )
    joints: tuple[str, ...] = option((), help="in a file with only a contract: names of the numbers, in order")


TASK_KEY = "task"
"""Key of the text signal: the task of a policy."""


@documented
@attrs.frozen
class SignalSpec:
    """One topic that fills a column of a dataset that policies do not see."""

    key: str = option(
        choices=(TASK_KEY, "next.reward", "next.done"), help="task: text, in place of the prompt; the others: a number"
    )
    topic: str = option(help="topic of the messages")
    type: str = option("", help="ROS 2 message type; by default String, Float32 or Bool of std_msgs")
    select: tuple[str, ...] = option(("data",), help="path to the text or number in the message")
    align: str = option(
        "hold", choices=("hold", "next"), help="hold: the newest message received by the tick; next: the first after it"
    )


MAX_AGE = 0.25
"""Default of `contract.max_age` [s], also for contracts recorded before it was stated; as `stale_timeout`, 25 states at
100 Hz. Part of the meaning of a fingerprint: a contract with another value has another one."""


@documented
@attrs.frozen
class ContractConfig:
    """The `contract:` section: rate, observations, actions and signals."""

    rate_hz: float = option(30.0, unit="Hz", gt=0, help="rate of observations and actions")
    max_duration_s: float = option(90.0, unit="s", gt=0, help="longest episode")
    max_age: float = option(
        MAX_AGE, unit="s", gt=0, help="greatest age of a held observation or command; an older one is missing"
    )
    observations: tuple[ObservationSpec, ...] = option((), help="topics -> observation keys")
    actions: tuple[ActionSpec, ...] = option((), help="the action vector -> executors")
    signals: tuple[SignalSpec, ...] = option((), help="topics -> task, reward and end of a dataset's rows")


@attrs.frozen
class ModelConfig(NamedComponentConfig):
    """A policy, the unit of its vectors, and its observations beyond the contract."""

    plugin_kind = "policy"

    norm_mode: str = option("radians", choices=NORM_MODES, help="unit of the joints in its vectors")
    units: str | None = option(None, help="type of what converts them; needed if several plugins offer a default")
    calibration: str | None = option(None, help="for norm_mode, in place of the hardware's: a name or a path")
    extra_observations: tuple[ObservationSpec, ...] = option((), help="observations beyond the contract")


@documented
@attrs.frozen
class Smoothing:
    """Blending of a new chunk into the plan."""

    enabled: bool = option(True, help="blend where chunks overlap; otherwise the new chunk replaces the plan")
    temporal_ensemble_coeff: float = option(0.01, help="c in w_k = exp(-c k), k = 0 the oldest prediction")


def _check_watermark(_: object, __: object, value: int | str) -> None:
    if isinstance(value, int) and value < 0:
        raise ValueError(f"{value} is too small, must be at least 0 actions, or auto")


@documented
@attrs.frozen
class DispatchConfig:
    """How the dispatcher keeps the plan filled."""

    watermark: int | Literal["auto"] = option(
        "auto",
        unit="actions",
        validator=_check_watermark,
        help="remaining length of the plan at which the next chunk is requested; auto: half a chunk, or more if the "
        "model's measured latency needs it",
    )
    strategy: str | None = option(
        None,
        choices=("replace", "ensemble", "rtc"),
        help="how a chunk joins the plan: replace it; ensemble: blend with it; rtc (real-time chunking): the policy "
        "continues it, where it can. None: ensemble, or replace with smoothing off",
    )
    smoothing: Smoothing = option(factory=Smoothing, help="blending of chunks")

    def __attrs_post_init__(self) -> None:
        if self.strategy == "ensemble" and not self.smoothing.enabled:
            raise ValueError("strategy ensemble blends chunks, which smoothing: {enabled: false} excludes")

    @property
    def joins_by(self) -> str:
        """The effective strategy: replace, ensemble or rtc."""
        return self.strategy or ("ensemble" if self.smoothing.enabled else "replace")


def devices_of(given: str | Mapping[str, str] | None) -> Mapping[str, str]:
    """Joint group -> the teleoperation device that moves it; empty group: a device that may move all joints."""
    return {"": given} if isinstance(given, str) else given or {}


@attrs.frozen
class InferenceConfig(ComponentConfig):
    """The model of a mode, and the engine that runs it."""

    plugin_kind = "engine"

    model: str = option(help="a name under models")
    type: str = option("monolithic", key="execution_mode", help="engine to run the model, one of those installed")
    request_timeout: float = option(5.0, unit="s", gt=0, help="time after which a request fails and the arm holds")
    prompt: str = option("", help="task for language-conditioned policies")
    intervene: str | Mapping[str, str] | None = option(
        None,
        help="device with which an operator takes the robot from the model and gives it back; groups as for teleop",
    )
    uses_transport: bool = not_a_key(False)
    """Whether it needs the transport."""
    weights_here: bool = not_a_key(True)
    """Whether the weights are on this machine."""

    @property
    def devices(self) -> Mapping[str, str]:
        """The devices of `intervene`, as `devices_of`."""
        return devices_of(self.intervene)


@documented
@attrs.frozen
class ControlMode:
    """A mode: its active executors, and the source of their commands."""

    executors: tuple[str, ...] = option(help="executors active in the mode")
    teleop: str | Mapping[str, str] | None = option(
        None, help="device under teleoperation that drives the mode, or joint group -> the device that moves it"
    )
    inference: InferenceConfig | None = option(None, help="model that drives the mode")
    dispatch: DispatchConfig = option(factory=DispatchConfig, help="how a model's plan is kept filled")
    planner: PlannerConfig | None = option(None, help="planner that drives the mode, with its options")
    name: str = not_a_key("")

    @property
    def devices(self) -> Mapping[str, str]:
        """The devices that drive the mode, as `devices_of`."""
        return devices_of(self.teleop)


def _check_dataset(_: object, __: object, value: str) -> None:
    folder = Path(value)
    if folder.is_absolute() or ".." in folder.parts or not folder.parts:
        raise ValueError(f"{str(folder)!r} is not below recording.root; give a folder's name, e.g. picks")


@attrs.frozen
class RecordingConfig(ComponentConfig):
    """Recording of episodes."""

    plugin_kind = "recorder"

    root: str = option("episodes", help="folder of all datasets; relative to the working directory")
    dataset: str = option("default", validator=_check_dataset, help="folder of the episodes of one task, below root")
    topics: str | tuple[str, ...] = option("contract", help="contract, all, or a list of topics")

    @property
    def folder(self) -> Path:
        """The dataset's folder."""
        return Path(self.root) / self.dataset


@attrs.frozen
class TransportConfig(ComponentConfig):
    """Communication between processes and machines."""

    plugin_kind = "transport"


@documented
@attrs.frozen
class Following:
    """Detection of joints that do not follow their setpoints, which is a fault."""

    distance: float = option(
        0.25, unit="rad", gt=0, help="distance from the setpoint, beyond the joint's lag; at most half of max_lead"
    )
    timeout: float = option(2.0, unit="s", gt=0, help="time at this distance before a fault")


@documented
@attrs.frozen
class Shedding:
    """Relief of joints that stay hot or overloaded: the arm moves to a pose, if one is given, and relaxes."""

    after: float = option(60.0, unit="s", gt=0, help="duration of such a condition before the arm relaxes")
    pose: str = option("", help="named pose in which the arm can rest without torque; empty: relax without moving")


@documented
@attrs.frozen
class ControlConfig:
    """The `control:` section."""

    rate_hz: float = option(100.0, unit="Hz", gt=0, le=1000, help="rate of the control loop")
    startup: str = option("hold", help="behaviour at the start, before the mode begins: hold, or pose NAME")
    stop: str = option("hold", help="behaviour at the stop: hold, relax, or pose NAME")
    priority: int = option(60, ge=1, le=99, help="SCHED_FIFO priority, if the machine permits it")
    state_timeout: float = option(0.1, unit="s", gt=0, help="time without a state from the hardware before a fault")
    peer_timeout: float = option(
        0.3,
        unit="s",
        gt=0.0,
        le=10.0,
        help="longest motion while the host process, or the control loop, is stopped or blocked, braking included",
    )
    stop_time: float = option(
        Deadman.hold_s,
        unit="s",
        ge=Deadman.hold_s,
        help="longest time, at full speed, until joints rest after the last report of the device that drives them; "
        "joints that need longer to brake are refused",
    )
    following_error: Following = option(factory=Following, help="detection of joints that do not follow setpoints")
    load_shedding: Shedding = option(factory=Shedding, help="relief of joints that stay hot or overloaded")
    guard: GuardConfig | None = option(None, help="what stops commands of every origin before a collision")


@documented
@attrs.frozen(slots=False, kw_only=True)
class RobotConfig:
    """A checked robot YAML. `source` is the file; `document` contains its plain values without secrets."""

    robot: Robot = option(help="joints, groups, models and poses")
    hardware: Mapping[str, HardwareConfig] = option(
        factory=dict, help="one component, or several named ones, each with its joints"
    )
    simulation: SimulationConfig | None = option(None, help="used with --sim, or without a hardware section")
    peripherals: Mapping[str, PeripheralConfig] = option(factory=dict, help="cameras and other sensors")
    executors: Mapping[str, ExecutorConfig] = option(help="name -> type, group and options of what moves joints")
    models: Mapping[str, ModelConfig] = option(factory=dict, help="policies by name")
    control_modes: Mapping[str, ControlMode] = option(help="name -> active executors, and the source of their commands")
    default_control_mode: str = option(help="first mode of a run")
    teleoperation: Mapping[str, TeleopConfig] = option(factory=dict, help="teleoperation devices by name")
    contract: ContractConfig = option(factory=ContractConfig, help="how topics become observations and actions")
    recording: RecordingConfig | None = option(None, help="recording of episodes")
    transport: TransportConfig | None = option(None, help="communication between processes and machines")
    viewer: ViewerConfig | None = option(None, help="display of the robot")
    terminal: TerminalConfig | None = option(None, help="what reads keys and shows the run; else the installed default")
    control: ControlConfig = option(factory=ControlConfig, help="the control loop")
    plugin_sections: Mapping[str, ComponentConfig] = not_a_key(factory=dict)
    """Name -> section defined by a plugin, for those in the file."""
    simulated: bool = not_a_key(False)
    """Whether this run uses `simulation` instead of `hardware`."""
    absent_models: Mapping[str, PluginNotInstalled] = not_a_key(factory=dict, repr=False, eq=False)
    """Model of `robot.description` -> the package that contains it and is not installed."""
    unavailable: Mapping[str, str] = not_a_key(factory=dict, repr=False, eq=False)
    """Mode -> why it is unavailable, and what to install."""
    missing: tuple[PluginNotInstalled, ...] = not_a_key((), repr=False, eq=False)
    """Types in the YAML without an installed plugin, which the first mode does not need."""
    source: Path = not_a_key(Path("<memory>"))
    closed_ends: Mapping[str, float | None] = not_a_key(factory=dict, eq=False)
    """Joint -> its lower limit [rad] if the hardware anchors it at its closed end, else None. In a simulation, the
    hardware determines this too. Joints of hardware without an installed plugin are left out."""
    document: Mapping[str, Any] = not_a_key(factory=dict, repr=False)
    complete: Mapping[str, Any] = not_a_key(factory=dict, repr=False, eq=False)
    """`document` with its secrets, only for other processes of the run; never write or show it."""
    secrets: Mapping[str, str] = not_a_key(factory=dict, repr=False, eq=False)
    """Secret -> text shown in its place."""

    @classmethod
    @cache
    def sections(cls) -> Mapping[str, attrs.Attribute[Any]]:
        """The sections of a robot YAML, with their types in the file."""
        return {name: _as_written(field) for name, field in fields(cls).items()}


def _as_written(field: attrs.Attribute[Any]) -> attrs.Attribute[Any]:
    """A section's field with its type in the file, where it may be missing but not null."""
    kind: Any = field.type
    component = ComponentConfig.within(kind)
    if get_origin(kind) is types.UnionType:
        kind, _ = get_args(kind)
    elif component is not None and "name" in fields(component):
        return field.evolve(type=tuple[component, ...], default=())  # type: ignore[valid-type]
    return field.evolve(type=kind)
