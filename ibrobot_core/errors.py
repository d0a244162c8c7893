"""The errors that a user may see; each prints as one line and carries the command's exit code."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path

import attrs

_LISTED = 50
"""How many problems a message lists; a screen holds no more."""


class IbrobotError(Exception):
    """Base of every error that ibrobot raises on purpose.

    The command line prints `str(error)` and exits with `exit_code`; anything else is a bug: see `ibrobot_core.bugs`.
    """

    exit_code = 1


@attrs.frozen
class Problem:
    """One thing wrong with a config file."""

    file: Path | str
    """The file as it was given, or the override, e.g. `--set control.rate_hz=abc`."""
    line: int
    path: str
    message: str

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}: " if self.line else f"{self.file}: "
        return f"{where}{self.path}: {self.message}" if self.path else f"{where}{self.message}"


class ConfigError(IbrobotError):
    """A robot YAML that cannot be used, e.g. an unknown key; `problems` has every fault found, in file order."""

    exit_code = 2

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        lines = [str(problem) for problem in self.problems[:_LISTED]]
        more = len(self.problems) - _LISTED
        super().__init__("\n".join([*lines, f"and {more} more"] if more > 0 else lines))


class PluginError(IbrobotError):
    """A plugin that is asked for but is missing or broken, e.g. a `type` without its package."""

    exit_code = 2


def plugin_type(kind: str, type: str) -> str:
    """What messages call a type of a kind, e.g. `teleop type 'joystick'`."""
    named = {"command": f"ibrobot {type}", "section": f"section {type!r}"}
    return named.get(kind, f"{kind} type {type!r}")


class PluginNotInstalled(PluginError):
    """A type whose plugin is not installed, or is broken.

    Args:
        kind: e.g. `teleop`, `section` or `command`.
        type: as the YAML has it, or the command's name.
        package: which offers it.
        reason: why the plugin cannot be used, where it is installed.
    """

    def __init__(self, kind: str, type: str, package: str, reason: str = "") -> None:
        self.kind = kind
        self.type = type
        self.package = package
        self.reason = reason
        self.missing = reason or f"{plugin_type(kind, type)} needs a plugin that is not installed"
        self.remedy = f"pip install {'--force-reinstall ' if reason else ''}{package}"
        super().__init__(reason or f"{self.missing}: {self.remedy}")


class MissingDependency(IbrobotError):
    """A library that a type needs and this machine lacks, e.g. no OpenGL for simulated cameras.

    Args:
        missing: what is missing, and what for.
        apt: the Debian packages that bring it; `remedy` then is the command that installs them.
        remedy: what to do about it, where that is not a matter of Debian packages.
    """

    exit_code = 2

    def __init__(self, missing: str, *, apt: Sequence[str] = (), remedy: str = "") -> None:
        self.missing = missing
        self.apt = tuple(apt)
        self.remedy = remedy or f"sudo apt-get install {' '.join(apt)}"
        super().__init__(f"{missing}; {self.remedy}")


class ContractError(IbrobotError):
    """Data that does not fit the contract, e.g. a policy trained on other joints than the robot's."""

    exit_code = 2


class HardwareError(IbrobotError):
    """Hardware that cannot be opened, read or written, e.g. a servo that stopped answering."""


class CalibrationError(IbrobotError):
    """A calibration that is missing or cannot be true, e.g. a range that crosses the encoder's end."""

    exit_code = 2


class SensorError(IbrobotError):
    """A sensor that cannot be opened or read, e.g. a camera that another program holds."""


class TeleopError(IbrobotError):
    """A teleoperation device that cannot be opened or read, e.g. no terminal for the keyboard."""


class PolicyError(IbrobotError):
    """A policy that cannot be loaded or run, e.g. a checkpoint without its statistics."""


class PlanCode(IntEnum):
    """Why a motion cannot be planned: names and values of moveit_msgs/msg/MoveItErrorCodes."""

    SUCCESS = 1
    FAILURE = 99999
    PLANNING_FAILED = -1
    INVALID_MOTION_PLAN = -2
    MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE = -3
    CONTROL_FAILED = -4
    TIMED_OUT = -6
    PREEMPTED = -7
    START_STATE_IN_COLLISION = -10
    GOAL_IN_COLLISION = -12
    GOAL_CONSTRAINTS_VIOLATED = -14
    INVALID_GROUP_NAME = -15
    INVALID_GOAL_CONSTRAINTS = -16
    INVALID_ROBOT_STATE = -17
    INVALID_LINK_NAME = -18
    INVALID_OBJECT_NAME = -19
    FRAME_TRANSFORM_FAILURE = -21
    COLLISION_CHECKING_UNAVAILABLE = -22
    START_STATE_INVALID = -26
    GOAL_STATE_INVALID = -27
    UNRECOGNIZED_GOAL_TYPE = -28
    NO_IK_SOLUTION = -31


class PlanningError(IbrobotError):
    """A motion that cannot be planned, e.g. a goal outside the joint limits.

    Args:
        message: what is in the way.
        code: the reason, as MoveIt names it.
    """

    def __init__(self, message: str, code: PlanCode = PlanCode.PLANNING_FAILED) -> None:
        super().__init__(message)
        self.code = code


class TransportError(IbrobotError):
    """A message that cannot be sent, e.g. a request that nobody serves."""


class WireError(IbrobotError):
    """Bytes that are no frame of the wire format, or a frame that has no bytes, e.g. one that was cut short."""


class RecorderError(IbrobotError):
    """A recording that cannot be written or read, e.g. a full disk."""


class DiskFull(RecorderError):
    """A disk with less space than an episode takes."""


class DatasetError(IbrobotError):
    """A dataset that cannot be written or read, e.g. a frame of another shape than the first."""


class GoalRejected(IbrobotError):
    """A goal that an executor refuses, e.g. a trajectory whose times do not increase."""


class ComponentFailed(IbrobotError):
    """A running component that died, e.g. a control process that was killed; the rest was stopped."""


class NotSupported(IbrobotError):
    """Something that this implementation cannot do, e.g. `control.stop: relax` on hardware without torque control."""

    exit_code = 2


class Declined(IbrobotError):
    """A question that the user answered with no; what was done before stays done."""

    def __init__(self) -> None:
        super().__init__("stopped: the answer was no")


_OF_THE_MACHINE = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.EFBIG, errno.EIO}
)


@contextmanager
def wrong_input() -> Iterator[None]:
    """Let commands exit with 2 for errors raised within: the user named something that cannot be used.

    Errors of the machine, such as a full disk, and of components that died keep their code. Also a decorator.
    """
    try:
        yield
    except IbrobotError as error:
        if not (isinstance(error, DiskFull | ComponentFailed | Declined) or _is_of_the_machine(error)):
            error.exit_code = ConfigError.exit_code
        raise


def _is_of_the_machine(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE:
            return True
        error = error.__cause__ or error.__context__
    return False
