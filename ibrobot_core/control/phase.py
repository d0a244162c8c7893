"""The phases of the control loop, and what leads from one to another."""

from __future__ import annotations

import enum
from collections.abc import Mapping


class Phase(enum.Enum):
    """What the control loop does; the value says when a command is refused."""

    ARRIVING = "while the robot moves to its startup pose"
    FAILED = "after the start has failed"
    RUNNING = "while executors command the robot"
    FAULTED = "before a reset"
    SHEDDING = "while the robot sheds its load"
    SHED = "before a reset of the robot, whose load was shed"
    STOPPING = "while the robot is stopping"


class Cause(enum.Enum):
    """What leads to another phase."""

    ARRIVED = "the startup pose is reached"
    FAULT = "a fault"
    EMERGENCY_STOP = "an emergency stop"
    OVERDUE = "a severe condition has lasted too long"
    RELAXED = "the load was shed"
    RESET = "a reset, or another episode"
    STOP = "the run ends"


TRANSITIONS: Mapping[Phase, Mapping[Cause, Phase]] = {
    Phase.ARRIVING: {
        Cause.ARRIVED: Phase.RUNNING, Cause.FAULT: Phase.FAILED, Cause.EMERGENCY_STOP: Phase.FAILED,
        Cause.STOP: Phase.STOPPING,
    },
    Phase.FAILED: {Cause.STOP: Phase.STOPPING},
    Phase.RUNNING: {
        Cause.FAULT: Phase.FAULTED, Cause.EMERGENCY_STOP: Phase.FAULTED, Cause.OVERDUE: Phase.SHEDDING,
        Cause.STOP: Phase.STOPPING,
    },
    Phase.FAULTED: {Cause.OVERDUE: Phase.SHEDDING, Cause.RESET: Phase.RUNNING, Cause.STOP: Phase.STOPPING},
    Phase.SHEDDING: {
        Cause.RELAXED: Phase.SHED, Cause.EMERGENCY_STOP: Phase.FAULTED, Cause.RESET: Phase.RUNNING,
        Cause.STOP: Phase.STOPPING,
    },
    Phase.SHED: {Cause.EMERGENCY_STOP: Phase.FAULTED, Cause.RESET: Phase.RUNNING, Cause.STOP: Phase.STOPPING},
    Phase.STOPPING: {},
}  # fmt: skip
"""The phase after each cause; a cause that is missing leaves the phase as it is."""
