"""The errors that a user may see; each is printed as one line and has the command's exit code."""

from __future__ import annotations

import copyreg
import errno
import json
import os
import shlex
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from importlib.util import find_spec
from pathlib import Path
from typing import Any, override

import attrs

_LISTED = 50
"""Maximum number of problems in a message, to fit on a screen."""


EXTRAS = Path(__file__).with_name("official_extras.json")
"""Extra of `ibrobot` -> the packages that it installs. `python tests/house/official_plugins.py` writes it."""


def how_to_install(*packages: str) -> str:
    """The command that installs packages into the environment that runs.

    An environment that uv made has no pip, and the pip of a shell may be another Python's. The environment variable
    IBROBOT_INSTALLER replaces the command, e.g. `pixi add --pypi`. Several packages that an extra of `ibrobot` covers
    are named by the smallest such extra.
    """
    wanted = dict.fromkeys(packages)
    extras: dict[str, list[str]] = json.loads(EXTRAS.read_bytes()) if len(wanted) > 1 else {}
    if covering := [name for name, content in extras.items() if wanted.keys() <= set(content)]:
        wanted = dict.fromkeys([f"ibrobot[{min(covering, key=lambda name: len(extras[name]))}]"])
    names = " ".join(f'"{each}"' if "[" in each else each for each in wanted)
    here = shlex.quote(sys.executable)
    if installer := os.environ.get("IBROBOT_INSTALLER"):
        return f"{installer} {names}"
    if find_spec("pip") is None:
        places = (Path(each) for each in (os.environ.get("VIRTUAL_ENV"), ".venv") if each)  # where uv looks
        is_active = any(each.exists() and each.samefile(sys.prefix) for each in places)
        return f"uv pip install {names}{'' if is_active else f' --python {here}'}"
    pip = shutil.which("pip")
    return f"{'pip' if pip and Path(pip).parent == Path(sys.executable).parent else f'{here} -m pip'} install {names}"


class IbrobotError(Exception):
    """Base of all errors that ibrobot raises on purpose.

    The command line prints `str(error)` and exits with `exit_code`; anything else is a bug, see
    `ibrobot_core.bug_reports`.
    """

    exit_code = 1
    from_input = True
    """Whether invalid input may be the cause, so that `wrong_input` sets the exit code."""

    @override
    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes send errors; those whose constructors make the text of other arguments stay as they are.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


@attrs.frozen
class Problem:
    """A problem in a config file."""

    file: Path | str
    """The given path of the file, or the override, e.g. `--set control.rate_hz=abc`."""
    line: int
    path: str
    message: str

    def __str__(self) -> str:
        where = f"{self.file}:{self.line}: " if self.line else f"{self.file}: "
        return f"{where}{self.path}: {self.message}" if self.path else f"{where}{self.message}"


class ConfigError(IbrobotError):
    """A robot YAML is invalid, e.g. because of an unknown key; `problems` has all problems, in file order."""

    exit_code = 2

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        lines = [str(problem) for problem in self.problems[:_LISTED]]
        more = len(self.problems) - _LISTED
        super().__init__("\n".join([*lines, f"and {more} more"] if more > 0 else lines))


class PluginError(IbrobotError):
    """A required plugin is missing or broken, e.g. the package of a `type`."""

    exit_code = 2


def plugin_type(kind: str, type: str) -> str:
    """The name of a type in messages, e.g. `teleop type 'joystick'`."""
    named = {"command": f"ibrobot {type}", "section": f"section {type!r}", "source": f"a mode with {type}"}
    return named.get(kind, f"{kind} type {type!r}")


class PluginNotInstalled(PluginError):
    """The plugin of a type is not installed, or is broken.

    Args:
        kind: e.g. `teleop`, `section` or `command`.
        type: the type in the YAML, or the command's name.
        package: the package that offers it.
        reason: why the plugin cannot be used, if it is installed.
    """

    def __init__(self, kind: str, type: str, package: str, reason: str = "") -> None:
        self.kind = kind
        self.type = type
        self.package = package
        self.reason = reason
        self.missing = reason or f"{plugin_type(kind, type)} needs a plugin that is not installed"
        self.remedy = how_to_install(*(["--force-reinstall"] if reason else []), package)
        super().__init__(reason or f"{self.missing}: {self.remedy}")


class MissingDependency(IbrobotError):
    """This machine lacks a library that a type needs, e.g. OpenGL for simulated cameras.

    Args:
        missing: the missing library and its purpose.
        apt: Debian packages that contain it; `remedy` is then the command that installs them.
        remedy: the remedy, if it is not to install Debian packages.
    """

    exit_code = 2

    def __init__(self, missing: str, *, apt: Sequence[str] = (), remedy: str = "") -> None:
        self.missing = missing
        self.apt = tuple(apt)
        self.remedy = remedy or f"sudo apt-get install {' '.join(apt)}"
        super().__init__(f"{missing}; {self.remedy}")


class ContractError(IbrobotError):
    """Data does not fit the contract, e.g. a policy was trained with other joints than the robot's."""

    exit_code = 2


class HardwareError(IbrobotError):
    """Hardware cannot be opened, read or written, e.g. because a servo stopped answering."""


class CalibrationError(IbrobotError):
    """A calibration is missing or impossible, e.g. because a range crosses the encoder's end."""

    exit_code = 2


class SensorError(IbrobotError):
    """A sensor cannot be opened or read, e.g. because another program uses the camera."""


class TeleopError(IbrobotError):
    """A teleoperation device cannot be opened or read, e.g. because the keyboard has no terminal."""


class PolicyError(IbrobotError):
    """A policy cannot be loaded or run, e.g. because a checkpoint lacks its statistics."""


class PlanCode(IntEnum):
    """Reasons why a motion cannot be planned: names and values of moveit_msgs/msg/MoveItErrorCodes."""

    SUCCESS = 1
    FAILURE = 99999
    PLANNING_FAILED = -1
    INVALID_MOTION_PLAN = -2
    MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE = -3
    CONTROL_FAILED = -4
    TIMED_OUT = -6
    PREEMPTED = -7
    START_STATE_IN_COLLISION = -10
    START_STATE_VIOLATES_PATH_CONSTRAINTS = -11
    GOAL_IN_COLLISION = -12
    GOAL_VIOLATES_PATH_CONSTRAINTS = -13
    INVALID_GROUP_NAME = -15
    INVALID_GOAL_CONSTRAINTS = -16
    INVALID_ROBOT_STATE = -17
    INVALID_LINK_NAME = -18
    INVALID_OBJECT_NAME = -19
    FRAME_TRANSFORM_FAILURE = -21
    COLLISION_CHECKING_UNAVAILABLE = -22
    SENSOR_INFO_STALE = -24
    START_STATE_INVALID = -26
    UNRECOGNIZED_GOAL_TYPE = -28
    NO_IK_SOLUTION = -31


class PlanningError(IbrobotError):
    """A motion cannot be planned, e.g. because the goal is outside the joint limits.

    Args:
        message: the reason.
        code: MoveIt's code for the reason.
    """

    def __init__(self, message: str, code: PlanCode = PlanCode.PLANNING_FAILED) -> None:
        super().__init__(message)
        self.code = code


class TransportError(IbrobotError):
    """A message cannot be sent, e.g. because a request has no server."""


class RequestError(IbrobotError):
    """A request does not fit its service, e.g. because of an unknown key; nothing was done."""

    exit_code = 2


class WireError(IbrobotError):
    """Bytes are not a valid frame of the wire format, e.g. because they are truncated, or a frame cannot be encoded."""


class RecorderError(IbrobotError):
    """A recording cannot be written or read, e.g. because the disk is full."""


class DatasetError(IbrobotError):
    """A dataset cannot be written or read, e.g. because the shapes of frames differ."""


class GoalRejected(IbrobotError):
    """An executor refuses a goal, e.g. because the times of a trajectory do not increase."""


class ComponentFailed(IbrobotError):
    """A running component died, e.g. the control process was killed; the others were stopped.

    Args:
        message: the cause.
        exit_code: exit status of the run that it ends.
    """

    from_input = False

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Unsuccessful(IbrobotError):
    """A command ends with an exit code after it has printed its result, e.g. a check that finds faults.

    Args:
        result: what the command would return.
        exit_code: the exit code.
    """

    from_input = False

    def __init__(self, result: Any = None, exit_code: int = 1) -> None:
        super().__init__()
        self.result = result
        self.exit_code = exit_code


class NotSupported(IbrobotError):
    """An implementation does not support a feature, e.g. `control.stop: relax` without torque control."""

    exit_code = 2


_OF_THE_MACHINE = {errno.ENOSPC, errno.EDQUOT, errno.ENOMEM, errno.EMFILE, errno.ENFILE, errno.EFBIG, errno.EIO}


@contextmanager
def wrong_input() -> Iterator[None]:
    """A context and decorator with which errors make a command exit with 2, because the user gave invalid input.

    Errors of the machine (a full disk), of resources in use, and of components that died keep their exit code.
    """
    try:
        yield
    except IbrobotError as error:
        if error.from_input and not _is_of_the_machine(error):
            error.exit_code = ConfigError.exit_code
        raise


def _is_of_the_machine(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, OSError) and error.errno in _OF_THE_MACHINE:
            return True
        error = error.__cause__ or error.__context__
    return False
