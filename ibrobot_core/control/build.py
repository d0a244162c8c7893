"""From a robot YAML to a control core: the hardware and executors that it names, made by their plugins."""

from __future__ import annotations

from ibrobot_core.clock import Clock
from ibrobot_core.config import RobotConfig
from ibrobot_core.config.context import component_context
from ibrobot_core.control.core import ControlCore
from ibrobot_core.control.hardware_group import HardwareGroup
from ibrobot_core.errors import ConfigError, Problem
from ibrobot_core.interfaces import Context, Executor, Hardware
from ibrobot_core.plugins import Registry


def build_core(config: RobotConfig, registry: Registry, clock: Clock, seed: int) -> ControlCore:
    """The control core of `config`; nothing is connected yet.

    Raises:
        ConfigError: where there is neither hardware nor a simulation.
        PluginError: when a plugin is missing.
    """
    executors: dict[str, Executor] = {}
    for component in config.executors.values():
        ctx = _context(config, component.name, component.joints, clock, seed)
        executors[component.name] = registry.find("executor", component.type).make(component.options, ctx)
    return ControlCore(config, HardwareGroup(config.robot, _hardware(config, registry, clock, seed)), executors, clock)


def _hardware(config: RobotConfig, registry: Registry, clock: Clock, seed: int) -> dict[str, Hardware]:
    if config.simulated and config.simulation is not None:
        ctx = _context(config, "simulation", config.robot.joint_names, clock, seed)
        return {"simulation": registry.find("hardware", config.simulation.type).make(config.simulation.options, ctx)}
    if not config.hardware:
        problem = "neither hardware nor simulation is there: nothing to control"
        raise ConfigError([Problem(str(config.source), 0, "hardware", problem)])
    return {
        name: registry.find("hardware", component.type).make(
            component.options, _context(config, name, component.joints, clock, seed)
        )
        for name, component in config.hardware.items()
    }


def _context(config: RobotConfig, name: str, joints: tuple[str, ...], clock: Clock, seed: int) -> Context:
    simulation = config.simulation.options if config.simulated and config.simulation is not None else None
    return component_context(config, name, clock, seed, joints=joints, simulation=simulation)
