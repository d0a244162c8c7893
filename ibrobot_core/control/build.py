"""Builds a control core from a robot YAML: its hardware and executors, created by their plugins."""

from __future__ import annotations

from typing import Any

from ibrobot_core.clock import Clock
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.config import RobotConfig
from ibrobot_core.control.core import ControlCore
from ibrobot_core.control.hardware_group import HardwareGroup
from ibrobot_core.errors import ConfigError, Problem
from ibrobot_core.interfaces import Context
from ibrobot_core.plugins import Registry


def build_core(config: RobotConfig, registry: Registry, clock: Clock, seed: int) -> ControlCore:
    """Build the control core of `config` without connecting any hardware.

    Raises:
        ConfigError: if the robot has neither hardware nor a simulation.
        PluginError: if a plugin is missing.
    """
    simulation = config.simulation if config.simulated else None

    def make(kind: str, component: ComponentConfig, name: str, joints: tuple[str, ...]) -> Any:
        options = simulation.options if simulation is not None else None
        context = Context.of(config, name, clock, seed, joints=joints, simulation=options)
        return registry.create(kind, component.type, component.options, context)

    executors = {name: make("executor", each, name, each.joints) for name, each in config.executors.items()}
    if simulation is not None:
        hardware = {"simulation": make("hardware", simulation, "simulation", config.robot.joint_names)}
    elif config.hardware:
        hardware = {name: make("hardware", each, name, each.joints) for name, each in config.hardware.items()}
    else:
        problem = "neither hardware nor simulation is there: nothing to control"
        raise ConfigError([Problem(str(config.source), 0, "hardware", problem)])
    named = config.control.guard
    guard = None if named is None else make("guard", named, "guard", config.robot.joint_names)
    group = HardwareGroup(config.robot, hardware, config.control.state_timeout)
    return ControlCore(config, group, executors, clock, guard)
