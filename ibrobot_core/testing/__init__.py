"""Conformance suites for plugin authors: subclass the one of your kind, write `make`, and run pytest."""

from ibrobot_core.testing.contexts import control_context, host_context, make_robot
from ibrobot_core.testing.dataset import DatasetSuite
from ibrobot_core.testing.executor import ExecutorSuite
from ibrobot_core.testing.hardware import HardwareSuite, SimulatedHardwareSuite
from ibrobot_core.testing.planner import PlannerSuite
from ibrobot_core.testing.policy import PolicySuite
from ibrobot_core.testing.recorder import RecorderSuite
from ibrobot_core.testing.sensor import SensorSuite
from ibrobot_core.testing.suite import Suite, checks, failed_checks, run_checks
from ibrobot_core.testing.teleop import TeleopSuite
from ibrobot_core.testing.transport import TransportSuite
from ibrobot_core.testing.viewer import ViewerSuite

__all__ = [
    "DatasetSuite",
    "ExecutorSuite",
    "HardwareSuite",
    "PlannerSuite",
    "PolicySuite",
    "RecorderSuite",
    "SensorSuite",
    "SimulatedHardwareSuite",
    "Suite",
    "TeleopSuite",
    "TransportSuite",
    "ViewerSuite",
    "checks",
    "control_context",
    "failed_checks",
    "host_context",
    "make_robot",
    "run_checks",
]
