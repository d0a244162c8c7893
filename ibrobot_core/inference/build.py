"""A policy as a robot YAML describes it, in a process that runs nothing else of the robot."""

from __future__ import annotations

import logging

from ibrobot_core.clock import RealClock
from ibrobot_core.config import RobotConfig
from ibrobot_core.interfaces import Context, Policy
from ibrobot_core.plugins import Registry
from ibrobot_core.units import ns


def build_policy(config: RobotConfig, registry: Registry, name: str, seed: int = 0) -> Policy:
    """The model `name` of `config`, constructed and not loaded.

    Raises:
        PluginError: when its plugin is not installed.
        PolicyError: e.g. for a checkpoint without its statistics.
    """
    model = config.models[name]
    simulation = config.simulation.options if config.simulation is not None else None
    context = Context(
        name=name, clock=RealClock(), log=logging.getLogger(f"ibrobot.{name}"), robot=config.robot,
        joints=config.robot.joint_names, period_ns=ns(1.0 / config.control.rate_hz), seed=seed, simulation=simulation,
    )  # fmt: skip
    policy: Policy = registry.find("policy", model.type).make(model.options, context)
    return policy
