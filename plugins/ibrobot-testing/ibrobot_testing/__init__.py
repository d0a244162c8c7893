"""Conformance suites for plugin authors: subclass the one of your kind, write `make`, and run pytest."""

import pkgutil

import pytest

# Before they are imported, and wherever they are installed: assertions in the suites say what they compared.
pytest.register_assert_rewrite(*(f"{__name__}.{module.name}" for module in pkgutil.iter_modules(__path__)))

from ibrobot_testing.command import ibrobot_command
from ibrobot_testing.contexts import control_context, host_context, make_robot
from ibrobot_testing.descriptor import check_descriptor
from ibrobot_testing.engine import EngineSuite
from ibrobot_testing.executor import ExecutorSuite
from ibrobot_testing.hardware import HardwareSuite, SimulatedHardwareSuite
from ibrobot_testing.leaks import LeakCheck
from ibrobot_testing.policy import PolicySuite
from ibrobot_testing.recorder import RecorderSuite
from ibrobot_testing.section import SectionSuite, make_session
from ibrobot_testing.sensor import SensorSuite
from ibrobot_testing.service import declared_services, stand_in
from ibrobot_testing.suite import Suite, checks, failed_checks, run_checks
from ibrobot_testing.teleop import TeleopSuite
from ibrobot_testing.transport import TransportSuite
from ibrobot_testing.viewer import ViewerSuite

__all__ = [
    "EngineSuite",
    "ExecutorSuite",
    "HardwareSuite",
    "LeakCheck",
    "PolicySuite",
    "RecorderSuite",
    "SectionSuite",
    "SensorSuite",
    "SimulatedHardwareSuite",
    "Suite",
    "TeleopSuite",
    "TransportSuite",
    "ViewerSuite",
    "check_descriptor",
    "checks",
    "control_context",
    "declared_services",
    "failed_checks",
    "host_context",
    "ibrobot_command",
    "make_robot",
    "make_session",
    "run_checks",
    "stand_in",
]
