"""What every implementation is given at construction: its name, the clock, a logger, the robot, the bus."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import attrs

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock
from ibrobot_core.robot import Robot


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
