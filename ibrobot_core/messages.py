"""The ROS 2 message vocabulary as frozen classes; field names and order follow the `.msg` definitions.

Sources: common_interfaces (std_msgs, sensor_msgs, geometry_msgs, trajectory_msgs, diagnostic_msgs), geometry2
(tf2_msgs), and ibrobot_msgs. Differences from the wire: stamps and durations are integer nanoseconds,
and arrays are numpy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, cast

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ibrobot_core import plugin_messages

_EQUAL = attrs.cmp_using(eq=np.array_equal)
_NOTHING: Any = ()


def _float64s(value: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(value, dtype=np.float64)


def _float32s(value: ArrayLike) -> NDArray[np.float32]:
    return np.asarray(value, dtype=np.float32)


def _int32s(value: ArrayLike) -> NDArray[np.int32]:
    return np.asarray(value, dtype=np.int32)


def _uint8s(value: ArrayLike) -> NDArray[np.uint8]:
    return np.asarray(value, dtype=np.uint8)


JOINT_STATES = "/joint_states"
"""The topic of every `JointState`."""
ROBOT_STATUS = "/robot_status"
"""The topic of every `RobotStatus`."""
DIAGNOSTICS = "/diagnostics"
"""The topic of every `DiagnosticArray`."""
RUN_TOPICS = (JOINT_STATES, ROBOT_STATUS, DIAGNOSTICS)
"""The topics that every run publishes."""
MODEL_ANSWERS = "/model_answers"
"""The topic of a run with a model: a `ModelAnswer` for each request."""


@attrs.frozen
class Message:
    """Base of all messages. A subclass gives its class keywords, e.g. `class Force(Message, ros_type="…")`."""

    ros_type: ClassVar[str] = ""
    """The full ROS 2 name."""
    whole: ClassVar[tuple[str, ...]] = ()
    """The paths to all of its numbers, for observations without `select`."""
    definition: ClassVar[str] = ""
    """The text of its `.msg` file, if ROS 2 does not define it."""

    def __init_subclass__(cls, ros_type: str = "", whole: tuple[str, ...] = (), definition: str = "") -> None:
        if ros_type:  # attrs creates each class a second time, without the keywords
            cls.ros_type, cls.whole, cls.definition = ros_type, whole, definition


@attrs.frozen
class Header:
    """std_msgs/msg/Header: time and frame of a message. `stamp_ns` is `stamp` [ns]."""

    stamp_ns: int = 0
    frame_id: str = ""


@attrs.frozen
class Bool(Message, ros_type="std_msgs/msg/Bool", whole=("data",)):
    """std_msgs/msg/Bool."""

    data: bool


@attrs.frozen
class Int8(Message, ros_type="std_msgs/msg/Int8", whole=("data",)):
    """std_msgs/msg/Int8: -128 to 127."""

    data: int


@attrs.frozen
class Int32(Message, ros_type="std_msgs/msg/Int32", whole=("data",)):
    """std_msgs/msg/Int32."""

    data: int


@attrs.frozen
class String(Message, ros_type="std_msgs/msg/String"):
    """std_msgs/msg/String."""

    data: str


@attrs.frozen
class MultiArrayDimension:
    """std_msgs/msg/MultiArrayDimension."""

    label: str = ""
    size: int = 0
    stride: int = 0


@attrs.frozen
class MultiArrayLayout:
    """std_msgs/msg/MultiArrayLayout."""

    dim: tuple[MultiArrayDimension, ...] = ()
    data_offset: int = 0


@attrs.frozen
class Float32MultiArray(Message, ros_type="std_msgs/msg/Float32MultiArray", whole=("data",)):
    """std_msgs/msg/Float32MultiArray; `data` has shape (N,)."""

    data: NDArray[np.float32] = attrs.field(converter=_float32s, eq=_EQUAL)
    layout: MultiArrayLayout = MultiArrayLayout()


@attrs.frozen
class Float64MultiArray(Message, ros_type="std_msgs/msg/Float64MultiArray", whole=("data",)):
    """std_msgs/msg/Float64MultiArray; `data` has shape (N,)."""

    data: NDArray[np.float64] = attrs.field(converter=_float64s, eq=_EQUAL)
    layout: MultiArrayLayout = MultiArrayLayout()


@attrs.frozen
class Int32MultiArray(Message, ros_type="std_msgs/msg/Int32MultiArray", whole=("data",)):
    """std_msgs/msg/Int32MultiArray; `data` has shape (N,)."""

    data: NDArray[np.int32] = attrs.field(converter=_int32s, eq=_EQUAL)
    layout: MultiArrayLayout = MultiArrayLayout()


@attrs.frozen
class JointState(Message, ros_type="sensor_msgs/msg/JointState"):
    """sensor_msgs/msg/JointState: position [rad], velocity [rad/s], effort [Nm], shape (J,), or (0,) where unknown."""

    header: Header
    name: tuple[str, ...]
    position: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    velocity: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    effort: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)


@attrs.frozen
class Image(Message, ros_type="sensor_msgs/msg/Image"):
    """sensor_msgs/msg/Image: `data` holds `height` rows of `step` bytes, padding included, shape (height * step,)."""

    header: Header
    height: int
    width: int
    encoding: str
    step: int
    data: NDArray[np.uint8] = attrs.field(converter=_uint8s, eq=_EQUAL)
    is_bigendian: int = 0


@attrs.frozen
class CompressedImage(Message, ros_type="sensor_msgs/msg/CompressedImage"):
    """sensor_msgs/msg/CompressedImage: `data` is a JPEG or PNG file's bytes, shape (N,)."""

    header: Header
    format: str
    data: NDArray[np.uint8] = attrs.field(converter=_uint8s, eq=_EQUAL)


@attrs.frozen
class CameraInfo(Message, ros_type="sensor_msgs/msg/CameraInfo"):
    """sensor_msgs/msg/CameraInfo without binning and region of interest: `k` (9,), `r` (9,), `p` (12,), row-major."""

    header: Header
    height: int
    width: int
    distortion_model: str = "plumb_bob"
    d: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    k: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    r: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    p: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)


@attrs.frozen
class Vector3:
    """geometry_msgs/msg/Vector3."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@attrs.frozen
class Quaternion:
    """geometry_msgs/msg/Quaternion; scalar last, as in ROS."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@attrs.frozen
class Imu(Message, ros_type="sensor_msgs/msg/Imu", whole=("orientation", "angular_velocity", "linear_acceleration")):
    """sensor_msgs/msg/Imu: angular velocity [rad/s], linear acceleration [m/s^2]; covariances (9,), row-major."""

    header: Header
    orientation: Quaternion = Quaternion()
    angular_velocity: Vector3 = Vector3()
    linear_acceleration: Vector3 = Vector3()
    orientation_covariance: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    angular_velocity_covariance: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    linear_acceleration_covariance: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)


@attrs.frozen
class Joy(Message, ros_type="sensor_msgs/msg/Joy", whole=("axes", "buttons")):
    """sensor_msgs/msg/Joy: `axes` (A,) in -1..1, `buttons` (B,) 0 or 1."""

    header: Header
    axes: NDArray[np.float32] = attrs.field(default=_NOTHING, converter=_float32s, eq=_EQUAL)
    buttons: NDArray[np.int32] = attrs.field(default=_NOTHING, converter=_int32s, eq=_EQUAL)


@attrs.frozen
class PointField:
    """sensor_msgs/msg/PointField."""

    name: str
    offset: int
    datatype: int
    count: int = 1


@attrs.frozen
class PointCloud2(Message, ros_type="sensor_msgs/msg/PointCloud2"):
    """sensor_msgs/msg/PointCloud2: `data` has shape (height * row_step,)."""

    header: Header
    height: int
    width: int
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: NDArray[np.uint8] = attrs.field(converter=_uint8s, eq=_EQUAL)
    is_dense: bool = True


@attrs.frozen
class Pose(Message, ros_type="geometry_msgs/msg/Pose", whole=("position", "orientation")):
    """geometry_msgs/msg/Pose: position [m] and orientation."""

    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


@attrs.frozen
class PoseStamped(Message, ros_type="geometry_msgs/msg/PoseStamped", whole=("pose",)):
    """geometry_msgs/msg/PoseStamped."""

    header: Header
    pose: Pose


@attrs.frozen
class Twist(Message, ros_type="geometry_msgs/msg/Twist", whole=("linear", "angular")):
    """geometry_msgs/msg/Twist: linear [m/s], angular [rad/s]."""

    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


@attrs.frozen
class TwistStamped(Message, ros_type="geometry_msgs/msg/TwistStamped", whole=("twist",)):
    """geometry_msgs/msg/TwistStamped: along the axes of `header.frame_id`."""

    header: Header
    twist: Twist


@attrs.frozen
class TransformStamped(Message, ros_type="geometry_msgs/msg/TransformStamped", whole=("translation", "rotation")):
    """geometry_msgs/msg/TransformStamped: `child_frame_id` as seen from `header.frame_id`."""

    header: Header
    child_frame_id: str
    translation: Vector3 = Vector3()
    rotation: Quaternion = Quaternion()


@attrs.frozen
class TFMessage(Message, ros_type="tf2_msgs/msg/TFMessage"):
    """tf2_msgs/msg/TFMessage."""

    transforms: tuple[TransformStamped, ...]


@attrs.frozen
class JointTrajectoryPoint:
    """trajectory_msgs/msg/JointTrajectoryPoint; arrays (J,), or (0,) if not given; time from the start [ns]."""

    time_from_start_ns: int
    positions: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    velocities: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    accelerations: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)
    effort: NDArray[np.float64] = attrs.field(default=_NOTHING, converter=_float64s, eq=_EQUAL)


@attrs.frozen
class JointTrajectory(Message, ros_type="trajectory_msgs/msg/JointTrajectory"):
    """trajectory_msgs/msg/JointTrajectory."""

    header: Header
    joint_names: tuple[str, ...]
    points: tuple[JointTrajectoryPoint, ...]


@attrs.frozen
class KeyValue:
    """diagnostic_msgs/msg/KeyValue."""

    key: str
    value: str


@attrs.frozen
class DiagnosticStatus:
    """diagnostic_msgs/msg/DiagnosticStatus: level 0 OK, 1 WARN, 2 ERROR, 3 STALE."""

    OK: ClassVar[int] = 0
    WARN: ClassVar[int] = 1
    ERROR: ClassVar[int] = 2
    STALE: ClassVar[int] = 3
    level: int
    name: str
    message: str = ""
    hardware_id: str = ""
    values: tuple[KeyValue, ...] = ()


@attrs.frozen
class DiagnosticArray(Message, ros_type="diagnostic_msgs/msg/DiagnosticArray"):
    """diagnostic_msgs/msg/DiagnosticArray."""

    header: Header
    status: tuple[DiagnosticStatus, ...]


@attrs.frozen
class RobotStatus(Message, ros_type="ibrobot_msgs/msg/RobotStatus"):
    """ibrobot_msgs/msg/RobotStatus: mode, faults and state of the robot."""

    header: Header
    robot: str
    mode: str
    active_executors: tuple[str, ...] = ()
    estop: bool = False
    faults: tuple[str, ...] = ()
    episode: int = 0
    plan_length: int = 0
    latency_ms: float = 0.0
    strategy: str = ""
    smoothing: bool = False
    latency_p50_ms: float = 0.0
    latency_p99_ms: float = 0.0
    requests: int = 0
    holds: int = 0
    failures: int = 0
    timeouts: int = 0
    late_chunks: int = 0


@attrs.frozen
class ModelAnswer(Message, ros_type="ibrobot_msgs/msg/ModelAnswer"):
    """ibrobot_msgs/msg/ModelAnswer: a request to a model, and its answer; stamped when the answer came or failed.

    The request had the contract's frame at `observed_ns` and the prompt. `actions` is a chunk [rad], shape (N * J,),
    row-major, for the J joints from `observed_ns` on; empty without one.
    """

    header: Header
    request: int
    observed_ns: int
    model: str
    server: str
    weights: str
    prompt: str
    outcome: str
    error: str
    latency_ms: float
    infer_ms: float
    queue_ms: float
    step_ns: int
    joint_names: tuple[str, ...]
    actions: NDArray[np.float64] = attrs.field(converter=_float64s, eq=_EQUAL)


class MessageTypes(Mapping[str, type[Message]]):
    """Message classes by ROS 2 name: those of core, then those that installed plugins define."""

    def __init__(self, own: Mapping[str, type[Message]]) -> None:
        self._own = own
        self._asking = False

    def __getitem__(self, name: str) -> type[Message]:
        """The class; asks plugins only for a type that core lacks."""
        return self._own[name] if name in self._own else cast("type[Message]", self._of_plugins()[name].load())

    def __contains__(self, name: object) -> bool:
        """Whether there is one; imports no class."""
        return name in self._own or name in self._of_plugins()

    def __iter__(self) -> Iterator[str]:
        """All names."""
        return iter(dict.fromkeys((*self._own, *self._of_plugins())))

    def __len__(self) -> int:
        """How many there are."""
        return sum(1 for _ in self)

    def _of_plugins(self) -> Mapping[str, Any]:
        """Discovers the plugins. One that asks while it is loaded sees only core's types."""
        if self._asking:
            return {}
        self._asking = True
        try:
            return plugin_messages.source()
        finally:
            self._asking = False


MESSAGE_TYPES = MessageTypes(
    {
        each.ros_type: each
        for each in tuple(globals().values())
        if isinstance(each, type) and issubclass(each, Message) and each.ros_type
    }
)
"""Every message class by its ROS 2 name."""
