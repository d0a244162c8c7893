"""The interfaces of plugins: one abstract class per kind."""

from ibrobot_core.interfaces.context import Context, ModelContext
from ibrobot_core.interfaces.engine import Engine, EngineStats
from ibrobot_core.interfaces.executor import Executor, GoalState, GoalStatus, Plan
from ibrobot_core.interfaces.feature import Feature
from ibrobot_core.interfaces.guard import Guard
from ibrobot_core.interfaces.hardware import (
    EpisodeSetup,
    Hardware,
    JointReading,
    SceneObject,
    Signal,
    SimulatedHardware,
    Torque,
)
from ibrobot_core.interfaces.policy import Frame, PictureCodec, Policy, PolicySpec, PolicyVectors, Tensors
from ibrobot_core.interfaces.reader import EpisodeAddress, EpisodeReader
from ibrobot_core.interfaces.recorder import EpisodeEnd, EpisodeStart, Recorder
from ibrobot_core.interfaces.sensor import Sensor
from ibrobot_core.interfaces.teleop import OperatorEvent, Teleop, TeleopCommand
from ibrobot_core.interfaces.transport import Handler, Payload, Transport
from ibrobot_core.interfaces.viewer import Viewer
