"""What every implementation is given at construction: its name, the clock, a logger, the robot, the bus."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock
from ibrobot_core.robot import Robot

if TYPE_CHECKING:
    from ibrobot_core.config import RobotConfig
    from ibrobot_core.interfaces.policy import Policy
    from ibrobot_core.interfaces.transport import Transport


@attrs.frozen(eq=False)
class ModelContext:
    """What an engine needs to know of the model that it runs. New fields may come; none will go."""

    config: RobotConfig
    """The robot YAML. The model is `config.models[NAME]`, where NAME is the context's `name`."""
    policy: Policy
    """The robot's side of the model: constructed, not loaded. The run closes it, after the engine."""
    transport: Transport | None = None
    """The way to other machines, for engines whose descriptor says `uses_transport`. The run closes it."""
    timeout_s: float = 5.0
    """After this time a request has failed [s]: `inference.request_timeout`."""
    ending: threading.Event = attrs.field(factory=threading.Event)
    """Set when the run ends: `start` need not wait any longer."""


@attrs.frozen
class Context:
    """Handed to `make(options, ctx)`. New fields may come; none will go."""

    name: str
    """What the YAML calls this component, e.g. `top` for a camera."""
    clock: Clock
    log: logging.Logger
    robot: Robot
    joints: tuple[str, ...] = ()
    """The joints that this component owns, in its vectors' order: hardware and executors."""
    period_ns: int = 10_000_000
    """The control period [ns]."""
    seed: int = 0
    bus: Bus | None = None
    """The host's bus; None in the control process."""
    simulation: Any = None
    """The options of the simulation in use (an attrs instance of its plugin), which may run elsewhere; else None."""
    keys: Callable[[], Any] | None = None
    """Returns a new queue of keys typed in the terminal (`queue.SimpleQueue[str]`); None where there is no terminal."""
    model: ModelContext | None = None
    """For engines: the model, whose name is that of the context."""
