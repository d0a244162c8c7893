"""Where each name of `ibrobot_core.app` lives, in the groups of its page, for type checkers and `app.py`."""

# What a plugin adds to a run
from ibrobot_core.descriptors import (
    Command as Command,
    SectionDescriptor as SectionDescriptor,
    Kind as Kind,
    SourceDescriptor as SourceDescriptor,
    UnitsDescriptor as UnitsDescriptor,
    FeatureDescriptor as FeatureDescriptor,
)

# The robot YAML
from ibrobot_core.config import (
    RobotConfig as RobotConfig,
    find_config as find_config,
    load_config as load_config,
    from_document as from_document,
)
from ibrobot_core.config.expand import VARIABLE as VARIABLE
from ibrobot_core.schema import (
    ControlMode as ControlMode,
    ExecutorConfig as ExecutorConfig,
    ModelConfig as ModelConfig,
    Mount as Mount,
    Align as Align,
)
from ibrobot_core.config.load import (
    read_document as read_document,
    contract_alone as contract_alone,
)
from ibrobot_core.component_config import ComponentConfig as ComponentConfig
from ibrobot_core.config.overrides import (
    Override as Override,
    single_options as single_options,
)
from ibrobot_core.config.yaml_nodes import Document as Document, parse_yaml as parse_yaml
from ibrobot_core.config.show import dump_yaml as dump_yaml, plain as plain

# Installed plugins
from ibrobot_core.plugins import (
    Registry as Registry,
    installed_plugins as installed_plugins,
)

# A run
from ibrobot_core.launch.session import Session as Session
from ibrobot_core.interfaces.run import (
    LaunchRequest as LaunchRequest,
    RunView as RunView,
    StreamingRun as StreamingRun,
    GoalRun as GoalRun,
    GuardedRun as GuardedRun,
    RecordedRun as RecordedRun,
    MotionScope as MotionScope,
)
from ibrobot_core.launch.runtime import Runtime as Runtime
from ibrobot_core.component import Component as Component, SessionWorker as SessionWorker, CONTROL as CONTROL
from ibrobot_core.bug_reports import error_text as error_text
from ibrobot_core.interfaces.run_state import ControlState as ControlState
from ibrobot_core.run_hooks import RunHooks as RunHooks
from ibrobot_core.launch.episodes import Episodes as Episodes
from ibrobot_core.launch.models import check_models as check_models
from ibrobot_core.launch.absence import notes_of as notes_of

# Sources
from ibrobot_core.component import SourceWorker as SourceWorker
from ibrobot_core.launch.sources.operator_devices import OperatorDevices as OperatorDevices
from ibrobot_core.control.spline import Spline as Spline

# Planning
from ibrobot_core.interfaces.guard import Guard as Guard

# Topics and services
from ibrobot_core.bus import Bus as Bus, Subscription as Subscription, Received as Received
from ibrobot_core.services import (
    Service as Service,
    NoRequest as NoRequest,
    RequestLimits as RequestLimits,
)

# Episodes and datasets
from ibrobot_core.contract.frames import FrameAssembler as FrameAssembler, FrameSampler as FrameSampler
from ibrobot_core.selection import (
    JointFeature as JointFeature,
)
from ibrobot_core.contract.specs import SignalPart as SignalPart, joint_selection as joint_selection
from ibrobot_core.interfaces.policy import PolicyVectors as PolicyVectors
from ibrobot_core.units import NORM_MODES as NORM_MODES

# Commands
from ibrobot_core.cli.run import run_robot as run_robot
from ibrobot_core.cli.options import (
    ConfigOptions as ConfigOptions,
    RunOptions as RunOptions,
    ModeOptions as ModeOptions,
)
from ibrobot_core.cli.declared import (
    flag_of as flag_of,
    read_options as read_options,
)
from ibrobot_core.options import fields as fields, default_of as default_of
from ibrobot_core.events import (
    Event as Event,
    Emit as Emit,
    Failed as Failed,
    Shown as Shown,
)
from ibrobot_core.safe_output import (
    echo as echo,
    printable as printable,
    UNPRINTABLE as UNPRINTABLE,
    LogFormatter as LogFormatter,
)
from ibrobot_core.cli.display import RunDisplay as RunDisplay, RunTerminal as RunTerminal
from ibrobot_core.signals import on_signals as on_signals, end_signals as end_signals

# Processes
from ibrobot_core.channel import Channel as Channel, ChannelMessage as ChannelMessage
from ibrobot_core.child import Child as Child, run_child as run_child
from ibrobot_core.memory import create_memory as create_memory, set_malloc as set_malloc
from ibrobot_core.control.realtime import go_real_time as go_real_time
from ibrobot_core.component import raise_thread_priority as raise_thread_priority
from ibrobot_core.pulses import Pulse as Pulse

# Errors
from ibrobot_core.errors import (
    ConfigError as ConfigError,
    Problem as Problem,
    RequestError as RequestError,
    ComponentFailed as ComponentFailed,
    Unsuccessful as Unsuccessful,
    WireError as WireError,
    wrong_input as wrong_input,
)

__all__: list[str]

def home_of(name: str) -> str: ...
