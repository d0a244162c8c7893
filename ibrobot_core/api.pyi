"""Where each name of `ibrobot_core.api` lives, in the groups of its page, for type checkers and `api.py`."""

# What a plugin offers
from ibrobot_core.hookspecs import hookimpl as hookimpl
from ibrobot_core.descriptors import (
    Descriptor as Descriptor,
    HardwareDescriptor as HardwareDescriptor,
    MessageDescriptor as MessageDescriptor,
    SensorDescriptor as SensorDescriptor,
    TeleopDescriptor as TeleopDescriptor,
    PolicyDescriptor as PolicyDescriptor,
    EngineDescriptor as EngineDescriptor,
    ExecutorDescriptor as ExecutorDescriptor,
    TransportDescriptor as TransportDescriptor,
    RecorderDescriptor as RecorderDescriptor,
    ReaderDescriptor as ReaderDescriptor,
    DecoderDescriptor as DecoderDescriptor,
    ViewerDescriptor as ViewerDescriptor,
    ConfigFile as ConfigFile,
    Check as Check,
    Late as Late,
)

# Options
from ibrobot_core.options import (
    option as option,
    not_a_key as not_a_key,
    documented as documented,
    not_empty as not_empty,
    OptionFault as OptionFault,
    did_you_mean as did_you_mean,
)
from ibrobot_core.descriptors import Options as Options, StreamOptions as StreamOptions

# The robot
from ibrobot_core.robot import Robot as Robot, Joint as Joint, Description as Description, Vector as Vector
from ibrobot_core.config.expand import resolve_path as resolve_path

# Time
from ibrobot_core.clock import Clock as Clock, RealClock as RealClock, SteppedClock as SteppedClock
from ibrobot_core.units import NS_PER_S as NS_PER_S, ns as ns, seconds as seconds

# Devices
from ibrobot_core.interfaces import (
    Context as Context,
    Hardware as Hardware,
    SimulatedHardware as SimulatedHardware,
    JointReading as JointReading,
    Torque as Torque,
    Signal as Signal,
    EpisodeSetup as EpisodeSetup,
    SceneObject as SceneObject,
    Sensor as Sensor,
    Teleop as Teleop,
    TeleopCommand as TeleopCommand,
    OperatorEvent as OperatorEvent,
    Viewer as Viewer,
)
from ibrobot_core.interfaces.hardware import (
    Holding as Holding,
    Condition as Condition,
    Severity as Severity,
    nan_vector as nan_vector,
)
from ibrobot_core.interfaces.policy import ACTION as ACTION
from ibrobot_core.deadman import Deadman as Deadman

# Models
from ibrobot_core.interfaces import (
    Policy as Policy,
    PolicySpec as PolicySpec,
    Frame as Frame,
    Tensors as Tensors,
    PictureCodec as PictureCodec,
    Engine as Engine,
    ModelContext as ModelContext,
    Transport as Transport,
    Payload as Payload,
    Handler as Handler,
)

# Motion
from ibrobot_core.interfaces import (
    Executor as Executor,
    Plan as Plan,
    GoalState as GoalState,
    GoalStatus as GoalStatus,
)
from ibrobot_core.interfaces.executor import (
    ExecutorGoal as ExecutorGoal,
    FollowTrajectory as FollowTrajectory,
    MoveJoint as MoveJoint,
    SlowDown as SlowDown,
)

# Episodes and datasets
from ibrobot_core.interfaces import (
    Recorder as Recorder,
    EpisodeStart as EpisodeStart,
    EpisodeEnd as EpisodeEnd,
    Feature as Feature,
)
from ibrobot_core.interfaces.reader import (
    EpisodeReader as EpisodeReader,
    EpisodeAddress as EpisodeAddress,
    EpisodeSummary as EpisodeSummary,
    TopicSummary as TopicSummary,
    Recorded as Recorded,
)

# The contract
from ibrobot_core.contract.specs import (
    Contract as Contract,
    ObservationPart as ObservationPart,
    ActionPart as ActionPart,
)
from ibrobot_core.contract.image import pixels as pixels

# Errors
from ibrobot_core.errors import (
    IbrobotError as IbrobotError,
    CalibrationError as CalibrationError,
    ContractError as ContractError,
    DatasetError as DatasetError,
    GoalRejected as GoalRejected,
    HardwareError as HardwareError,
    MissingDependency as MissingDependency,
    how_to_install as how_to_install,
    NotSupported as NotSupported,
    PlanningError as PlanningError,
    PlanCode as PlanCode,
    PolicyError as PolicyError,
    RecorderError as RecorderError,
    SensorError as SensorError,
    TeleopError as TeleopError,
    TransportError as TransportError,
)

# Messages
from ibrobot_core.messages import (
    DIAGNOSTICS as DIAGNOSTICS,
    JOINT_STATES as JOINT_STATES,
    Message as Message,
    MESSAGE_TYPES as MESSAGE_TYPES,
    Header as Header,
    JointState as JointState,
    Image as Image,
    CompressedImage as CompressedImage,
    CameraInfo as CameraInfo,
    Imu as Imu,
    Joy as Joy,
    PointCloud2 as PointCloud2,
    PointField as PointField,
    Bool as Bool,
    Int8 as Int8,
    Int32 as Int32,
    Int32MultiArray as Int32MultiArray,
    Float32MultiArray as Float32MultiArray,
    Float64MultiArray as Float64MultiArray,
    MultiArrayLayout as MultiArrayLayout,
    MultiArrayDimension as MultiArrayDimension,
    String as String,
    Vector3 as Vector3,
    Quaternion as Quaternion,
    Pose as Pose,
    PoseStamped as PoseStamped,
    Twist as Twist,
    TwistStamped as TwistStamped,
    TransformStamped as TransformStamped,
    TFMessage as TFMessage,
    JointTrajectory as JointTrajectory,
    JointTrajectoryPoint as JointTrajectoryPoint,
    DiagnosticArray as DiagnosticArray,
    DiagnosticStatus as DiagnosticStatus,
    KeyValue as KeyValue,
    RobotStatus as RobotStatus,
    ModelAnswer as ModelAnswer,
    MODEL_ANSWERS as MODEL_ANSWERS,
)

__all__: list[str]

def home_of(name: str) -> str: ...
