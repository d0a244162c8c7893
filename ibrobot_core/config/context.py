"""The context that a plugin's `make` is given, from a robot YAML."""

from __future__ import annotations

import logging
from typing import Any

from ibrobot_core.clock import Clock
from ibrobot_core.config.schema import RobotConfig
from ibrobot_core.interfaces import Context
from ibrobot_core.units import ns


def component_context(config: RobotConfig, name: str, clock: Clock, seed: int = 0, **more: Any) -> Context:
    """The context of the component `name`.

    Args:
        config: the robot YAML.
        name: of the component.
        clock: the run's.
        seed: the run's.
        more: other fields of the context; `joints` are all of the robot's where left out.
    """
    fields = {
        "joints": config.robot.joint_names,
        "simulation": config.simulation.options if config.simulation is not None else None,
        **more,
    }
    log = logging.getLogger(f"ibrobot.{name}")
    period_ns = ns(1.0 / config.control.rate_hz)
    return Context(name=name, clock=clock, log=log, robot=config.robot, period_ns=period_ns, seed=seed, **fields)
