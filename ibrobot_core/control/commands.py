"""Commands of the host to control: frozen classes, which are messages only on the channel between the processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, get_args

import attrs
import numpy as np

from ibrobot_core.control.phase import Phase
from ibrobot_core.convert import Converter, shown
from ibrobot_core.errors import HardwareError
from ibrobot_core.interfaces.executor import ExecutorGoal
from ibrobot_core.options import fields


@attrs.frozen
class SwitchMode:
    """Enter a mode where the commands rest."""

    mode: str


@attrs.frozen
class ResetEpisode:
    """Set up the simulated scene again, which clears faults; not an emergency stop."""

    seed: int


@attrs.frozen
class EmergencyStop:
    """Brake and hold, whatever the robot does."""


@attrs.frozen
class RaiseFault:
    """Brake, and hold until a reset."""

    fault: str


@attrs.frozen
class ClearFaults:
    """Clear faults and the emergency stop, and enter the mode again at the measured positions."""

    stops: int | None = None
    """Number of emergency stops that the sender knew of; a newer one refuses it. None: all so far."""


@attrs.frozen
class SendGoal:
    """Pass a goal to an executor."""

    executor: str
    goal_id: str
    goal: ExecutorGoal
    stops: int | None = None
    """Number of emergency stops when it was requested; a newer one refuses it."""
    generation: int | None = None
    """Generation in which it was requested; another one refuses it."""


@attrs.frozen
class CancelGoals:
    """Cancel the goal of an executor, or all goals if it is empty; the executors then hold."""

    executor: str = ""


@attrs.frozen
class GetCounters:
    """Answer with all counters."""


@attrs.frozen
class Halt:
    """Begin the stop behaviour, and answer whether it has finished."""

    unmoved: bool = False
    """Whether nothing has moved the robot, so that torque that the start switched on goes off again."""
    ends: bool = False
    """Whether the control process ends once it has finished."""


@attrs.frozen
class BeginStartup:
    """Begin the motion to the startup pose, if there is one."""


@attrs.frozen
class ChangeWorld:
    """Tell the guard, if there is one, of a change of the world."""

    change: Mapping[str, Any]


@attrs.frozen
class LimitSpeed:
    """Keep all joints to a fraction of their velocity limits from now on; a lower one is refused while they move."""

    fraction: float


Command = (
    SwitchMode | ResetEpisode | EmergencyStop | RaiseFault | ClearFaults | SendGoal | CancelGoals | GetCounters | Halt
    | BeginStartup | ChangeWorld | LimitSpeed
)  # fmt: skip
_CLASSES = {kind.__name__: kind for kind in get_args(Command)}
_RESETTABLE = (Phase.RUNNING, Phase.FAULTED, Phase.SHEDDING, Phase.SHED)
PERMITTED: Mapping[type[Command], Sequence[Phase]] = {
    SwitchMode: (Phase.RUNNING,), SendGoal: (Phase.RUNNING,), ClearFaults: _RESETTABLE, ResetEpisode: _RESETTABLE,
}  # fmt: skip
"""The phases that permit a command; the others stop the robot or change nothing, and all phases permit them."""


def encode(command: Command, number: int) -> dict[str, Any]:
    """A command as a message, with the number that its answer repeats."""
    return {"do": type(command).__name__, "id": number, **_plain(command)}


def _plain(value: Any) -> Any:
    """A value of a command as JSON has it; a trajectory has thousands."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    if attrs.has(type(value)):
        return {name: _plain(getattr(value, name)) for name in fields(type(value))}
    return value


def decode(message: Mapping[str, Any]) -> Command:
    """The command in a message of another process.

    Raises:
        HardwareError: if there is no such command, or its fields are others.
    """
    arguments = {key: value for key, value in message.items() if key not in ("do", "id")}
    do = message.get("do")
    if not isinstance(do, str) or do not in _CLASSES:
        raise HardwareError(f"control has no command {shown(do):.40}; the commands are: {', '.join(_CLASSES)}")
    try:
        command: Command = Converter().structure(arguments, _CLASSES[do])
    except ValueError as error:
        raise HardwareError(f"malformed command {do}: {error}") from None
    return command


def raise_error(reply: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a reply, or raise if its command failed.

    Raises:
        HardwareError: with the message of the control loop.
    """
    if "error" in reply:
        raise HardwareError(str(reply["error"]))
    return reply
