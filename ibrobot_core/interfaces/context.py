"""The context that every implementation receives at construction: name, clock, logger, robot, bus."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Self

import attrs

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock
from ibrobot_core.interfaces.policy import Policy
from ibrobot_core.interfaces.run import RunView
from ibrobot_core.interfaces.transport import Transport
from ibrobot_core.robot import Robot
from ibrobot_core.schema import RobotConfig
from ibrobot_core.units import ns


@attrs.frozen(eq=False)
class ModelContext:
    """The model that an engine runs. Fields may be added, but not removed."""

    config: RobotConfig
    """The robot YAML. The model is `config.models[NAME]`, where NAME is the context's `name`."""
    policy: Policy
    """The robot's side of the model: constructed, not loaded. The run closes it after the engine."""
    transport: Transport | None = None
    """The transport to other machines, for engines with `uses_transport` in their descriptor. The run closes it."""
    timeout_s: float = 5.0
    """Timeout of a request [s], from `inference.request_timeout`."""
    ending: threading.Event = attrs.field(factory=threading.Event)
    """Set when the run ends, so that `start` can stop waiting."""


@attrs.frozen
class Context:
    """The argument `ctx` of `make(options, ctx)`. Fields may be added, but not removed."""

    name: str
    """The component's name in the YAML, e.g. `top` for a camera."""
    clock: Clock
    log: logging.Logger
    robot: Robot
    joints: tuple[str, ...] = ()
    """The joints that hardware or an executor owns, in the order of its vectors."""
    period_ns: int = 10_000_000
    """The control period [ns]."""
    seed: int = 0
    bus: Bus | None = None
    """The host's bus; None in the control process."""
    simulation: Any = None
    """Options of the simulation in use, which may run in another process; None without simulation."""
    keys: Callable[[], Any] | None = None
    """Returns a new queue of keys typed in the terminal (`queue.SimpleQueue[str]`); None without a terminal."""
    model: ModelContext | None = None
    """For engines: the model, whose name is that of the context."""
    session: RunView | None = None
    """The run, for what is made in its process; None elsewhere."""
    source: str = ""
    """The robot YAML if the robot can be simulated, for messages; else empty."""

    @classmethod
    def of(cls, config: RobotConfig, name: str, clock: Clock, seed: int = 0, **more: Any) -> Self:
        """The context for the `make` of a component's plugin.

        Args:
            config: the robot YAML.
            name: name of the component.
            clock: the clock of the run.
            seed: the seed of the run.
            more: other fields; `joints` defaults to all joints of the robot.
        """
        simulation, source = (config.simulation.options, str(config.source)) if config.simulation else (None, "")
        robot: Robot = more.get("robot", config.robot)
        given = {"robot": robot, "joints": robot.joint_names, "simulation": simulation, "source": source, **more}
        log, period_ns = logging.getLogger(f"ibrobot.{name}"), ns(1.0 / config.control.rate_hz)
        return cls(name=name, clock=clock, log=log, period_ns=period_ns, seed=seed, **given)
