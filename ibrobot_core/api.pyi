"""Where each name of `ibrobot_core.api` lives: the one list that type checkers and `api.py` read."""

from ibrobot_core.hookspecs import hookimpl as hookimpl
from ibrobot_core.descriptors import (
    Check as Check,
    Command as Command,
    ConfigFile as ConfigFile,
    DatasetDescriptor as DatasetDescriptor,
    DecoderDescriptor as DecoderDescriptor,
    Descriptor as Descriptor,
    EngineDescriptor as EngineDescriptor,
    ExecutorDescriptor as ExecutorDescriptor,
    Flag as Flag,
    GuideDescriptor as GuideDescriptor,
    HardwareDescriptor as HardwareDescriptor,
    PanelDescriptor as PanelDescriptor,
    PlannerDescriptor as PlannerDescriptor,
    PolicyDescriptor as PolicyDescriptor,
    ReaderDescriptor as ReaderDescriptor,
    RecorderDescriptor as RecorderDescriptor,
    SectionDescriptor as SectionDescriptor,
    SensorDescriptor as SensorDescriptor,
    SourceDescriptor as SourceDescriptor,
    TeleopDescriptor as TeleopDescriptor,
    TransportDescriptor as TransportDescriptor,
    ViewerDescriptor as ViewerDescriptor,
)
from ibrobot_core.options import (
    NoOptions as NoOptions,
    OptionFault as OptionFault,
    OptionName as OptionName,
    did_you_mean as did_you_mean,
    documented as documented,
    not_empty as not_empty,
    option as option,
)
from ibrobot_core.executor_options import StreamOptions as StreamOptions
from ibrobot_core.interfaces import (
    AnyGoal as AnyGoal,
    Condition as Condition,
    Context as Context,
    DatasetSummary as DatasetSummary,
    DatasetWriter as DatasetWriter,
    Engine as Engine,
    EngineStats as EngineStats,
    EpisodeSetup as EpisodeSetup,
    EpisodeAddress as EpisodeAddress,
    EpisodeEnd as EpisodeEnd,
    EpisodeReader as EpisodeReader,
    EpisodeStart as EpisodeStart,
    EpisodeSummary as EpisodeSummary,
    Executor as Executor,
    Feature as Feature,
    Frame as Frame,
    Goal as Goal,
    GoalState as GoalState,
    GoalStatus as GoalStatus,
    Guide as Guide,
    Handler as Handler,
    Hardware as Hardware,
    Holding as Holding,
    JointGoal as JointGoal,
    JointReading as JointReading,
    LinearGoal as LinearGoal,
    ModelContext as ModelContext,
    NamedGoal as NamedGoal,
    OperatorEvent as OperatorEvent,
    OrientationPolicy as OrientationPolicy,
    Payload as Payload,
    PictureCodec as PictureCodec,
    Plan as Plan,
    PlanRequest as PlanRequest,
    PlanResult as PlanResult,
    Planner as Planner,
    Policy as Policy,
    PolicySpec as PolicySpec,
    PoseGoal as PoseGoal,
    PositionGoal as PositionGoal,
    Question as Question,
    Recorded as Recorded,
    Recorder as Recorder,
    SceneObject as SceneObject,
    Sensor as Sensor,
    Severity as Severity,
    Signal as Signal,
    SimulatedHardware as SimulatedHardware,
    Teleop as Teleop,
    TeleopCommand as TeleopCommand,
    Tensors as Tensors,
    TopicSummary as TopicSummary,
    Torque as Torque,
    Transport as Transport,
    Viewer as Viewer,
    begin_operation as begin_operation,
    find_episode as find_episode,
    nan_vector as nan_vector,
    short_name as short_name,
    operate as operate,
    trajectory_goal as trajectory_goal,
)
from ibrobot_core.interfaces.policy import copied_tensors as copied_tensors
from ibrobot_core.interfaces.transport import HANDLER_THREADS as HANDLER_THREADS
from ibrobot_core.errors import (
    CalibrationError as CalibrationError,
    ComponentFailed as ComponentFailed,
    ConfigError as ConfigError,
    ContractError as ContractError,
    DatasetError as DatasetError,
    Declined as Declined,
    DiskFull as DiskFull,
    GoalRejected as GoalRejected,
    HardwareError as HardwareError,
    IbrobotError as IbrobotError,
    InUse as InUse,
    MissingDependency as MissingDependency,
    NotSupported as NotSupported,
    PlanCode as PlanCode,
    PlanningError as PlanningError,
    PluginError as PluginError,
    PolicyError as PolicyError,
    Problem as Problem,
    RecorderError as RecorderError,
    RequestError as RequestError,
    SensorError as SensorError,
    TeleopError as TeleopError,
    TransportError as TransportError,
    WireError as WireError,
    wrong_input as wrong_input,
)
from ibrobot_core.messages import (
    MESSAGE_TYPES as MESSAGE_TYPES,
    Bool as Bool,
    CameraInfo as CameraInfo,
    CompressedImage as CompressedImage,
    DiagnosticArray as DiagnosticArray,
    DiagnosticStatus as DiagnosticStatus,
    Float32MultiArray as Float32MultiArray,
    Float64MultiArray as Float64MultiArray,
    Header as Header,
    Image as Image,
    Imu as Imu,
    Int8 as Int8,
    Int32 as Int32,
    Int32MultiArray as Int32MultiArray,
    JointState as JointState,
    JointTrajectory as JointTrajectory,
    JointTrajectoryPoint as JointTrajectoryPoint,
    Joy as Joy,
    KeyValue as KeyValue,
    Message as Message,
    MultiArrayDimension as MultiArrayDimension,
    MultiArrayLayout as MultiArrayLayout,
    PointCloud2 as PointCloud2,
    PointField as PointField,
    Pose as Pose,
    PoseStamped as PoseStamped,
    Quaternion as Quaternion,
    RobotStatus as RobotStatus,
    String as String,
    TFMessage as TFMessage,
    TransformStamped as TransformStamped,
    Twist as Twist,
    TwistStamped as TwistStamped,
    Variant as Variant,
    VariantsList as VariantsList,
    Vector3 as Vector3,
)
from ibrobot_core.robot import Description as Description, Joint as Joint, Robot as Robot, Vector as Vector
from ibrobot_core.deadman import HOLD_S as HOLD_S, Deadman as Deadman
from ibrobot_core.keys import HeldKeys as HeldKeys, KeyEvent as KeyEvent
from ibrobot_core.clock import Clock as Clock, RealClock as RealClock, SteppedClock as SteppedClock
from ibrobot_core.bus import Bus as Bus, Received as Received, Subscription as Subscription
from ibrobot_core.services import (
    NoRequest as NoRequest,
    Plain as Plain,
    RequestLimits as RequestLimits,
    Service as Service,
)
from ibrobot_core.component import (
    CONTROL as CONTROL,
    Component as Component,
    Worker as Worker,
    error_line as error_line,
    error_text as error_text,
    raise_thread_priority as raise_thread_priority,
)
from ibrobot_core.launch.session import (
    CommandSource as CommandSource,
    LaunchRequest as LaunchRequest,
    Session as Session,
    SessionWorker as SessionWorker,
    StateWatch as StateWatch,
)
from ibrobot_core.launch.sources.operator_devices import OperatorDevices as OperatorDevices
from ibrobot_core.launch.sources.policy import PolicySource as PolicySource
from ibrobot_core.launch.sources.source_worker import SourceWorker as SourceWorker
from ibrobot_core.control.link import ControlState as ControlState
from ibrobot_core.control.spline import Spline as Spline
from ibrobot_core.launch.runtime import (
    ESTOP as ESTOP,
    RESET as RESET,
    SET_MODE as SET_MODE,
    Runtime as Runtime,
    SetMode as SetMode,
)
from ibrobot_core.cli.run import run_robot as run_robot
from ibrobot_core.launch.absence import absent_sensors as absent_sensors, describe_absent as describe_absent
from ibrobot_core.launch.models import check_models as check_models
from ibrobot_core.cli.options import (
    EpisodePath as EpisodePath,
    run_options as run_options,
    run_overrides as run_overrides,
)
from ibrobot_core.run_hooks import RUN_KEYS as RUN_KEYS, RunHooks as RunHooks
from ibrobot_core.launch.transport import TransportLink as TransportLink
from ibrobot_core.units import (
    LEROBOT_MODES as LEROBOT_MODES,
    NORM_MODES as NORM_MODES,
    NS_PER_S as NS_PER_S,
    TICKS_PER_TURN as TICKS_PER_TURN,
    degrees as degrees,
    lerobot_to_radians as lerobot_to_radians,
    lerobot_to_ticks as lerobot_to_ticks,
    ns as ns,
    radians as radians,
    radians_to_lerobot as radians_to_lerobot,
    radians_to_ticks as radians_to_ticks,
    seconds as seconds,
    ticks_to_lerobot as ticks_to_lerobot,
    ticks_to_radians as ticks_to_radians,
)
from ibrobot_core.calibration import (
    MAX_HOMING_OFFSET as MAX_HOMING_OFFSET,
    MIDDLE_TICK as MIDDLE_TICK,
    ZERO_AT as ZERO_AT,
    ZERO_AT_POSE as ZERO_AT_POSE,
    ZERO_AT_RANGE as ZERO_AT_RANGE,
    Calibration as Calibration,
    JointCalibration as JointCalibration,
    calibration_path as calibration_path,
    companion_path as companion_path,
    load_calibration as load_calibration,
)
from ibrobot_core.contract.specs import (
    ActionPart as ActionPart,
    Contract as Contract,
    ObservationPart as ObservationPart,
    SignalPart as SignalPart,
)
from ibrobot_core.contract.image import pixels as pixels
from ibrobot_core.contract.frames import FrameAssembler as FrameAssembler
from ibrobot_core.contract.joint_units import (
    JointUnits as JointUnits,
    calibrations as calibrations,
    with_closed_ends as with_closed_ends,
)
from ibrobot_core.selection import Leaf as Leaf, Selection as Selection, value_at as value_at
from ibrobot_core.config import (
    RobotConfig as RobotConfig,
    find_config as find_config,
    from_document as from_document,
    load_config as load_config,
)
from ibrobot_core.config.load import (
    contract_alone as contract_alone,
    read_document as read_document,
    shipped_configs as shipped_configs,
)
from ibrobot_core.config.missing import unavailable_modes as unavailable_modes
from ibrobot_core.config.schema import (
    TASK_KEY as TASK_KEY,
    Align as Align,
    ControlMode as ControlMode,
    ExecutorConfig as ExecutorConfig,
    ImageSpec as ImageSpec,
    Mount as Mount,
    RecordingConfig as RecordingConfig,
    TransportConfig as TransportConfig,
)
from ibrobot_core.config.models import (
    DescriptionModel as DescriptionModel,
    ModelError as ModelError,
    XmlElement as XmlElement,
    read_mjcf as read_mjcf,
    read_xml as read_xml,
)
from ibrobot_core.config.expand import resolve_path as resolve_path
from ibrobot_core.config.overrides import apply_overrides as apply_overrides, single_options as single_options
from ibrobot_core.config.show import dump_yaml as dump_yaml
from ibrobot_core.config.yaml_nodes import Document as Document, parse_yaml as parse_yaml
from ibrobot_core.plugins import (
    Registry as Registry,
    example_type as example_type,
    installed_plugins as installed_plugins,
)
from ibrobot_core.inference.build import build_policy as build_policy
from ibrobot_core.contract.metadata import robot_metadata as robot_metadata
from ibrobot_core.launch.episodes import Episodes as Episodes
from ibrobot_core.control.realtime import go_real_time as go_real_time
from ibrobot_core.memory import create_memory as create_memory, set_malloc as set_malloc
from ibrobot_core.child import Channel as Channel, Child as Child, Failure as Failure, open_parent as open_parent
from ibrobot_core.signals import end_signals as end_signals, on_signals as on_signals
from ibrobot_core.outside import LogFormatter as LogFormatter, echo as echo
from ibrobot_core.ownership import Ownership as Ownership
from ibrobot_core.screen import Screen as Screen, styled as styled
from ibrobot_core.terminal import KeyReader as KeyReader, check_key as check_key

__all__: list[str]

def home_of(name: str) -> str: ...
