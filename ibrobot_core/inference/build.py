"""Builds a policy from a robot YAML, in a process that runs no other part of the robot."""

from __future__ import annotations

from ibrobot_core.clock import RealClock
from ibrobot_core.config import RobotConfig
from ibrobot_core.interfaces import Policy
from ibrobot_core.plugins import Registry


def build_policy(config: RobotConfig, registry: Registry, name: str, seed: int = 0) -> Policy:
    """Construct the model `name` of `config` without loading it.

    Raises:
        PluginError: if its plugin is not installed.
        PolicyError: e.g. for a checkpoint without its statistics.
    """
    model = config.models[name]
    policy: Policy = registry.find("policy", model.type).make(model.options, config.context(name, RealClock(), seed))
    return policy
