"""Builds a policy from a robot YAML, in a process that runs no other part of the robot."""

from __future__ import annotations

from ibrobot_core.clock import RealClock
from ibrobot_core.config import RobotConfig
from ibrobot_core.interfaces import Context, Policy
from ibrobot_core.interfaces.run import Plugins


def build_policy(config: RobotConfig, registry: Plugins, name: str, seed: int = 0) -> Policy:
    """Construct the model `name` of `config` without loading it.

    Raises:
        PluginError: if its plugin is not installed.
        PolicyError: e.g. for a checkpoint without its statistics.
    """
    model = config.models[name]
    context = Context.of(config, name, RealClock(), seed)
    policy: Policy = registry.create("policy", model.type, model.options, context)
    return policy
