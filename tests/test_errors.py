"""Errors that worker processes send arrive as they were raised."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from multiprocessing import Pipe

import pytest

from ibrobot_core import errors
from ibrobot_core.errors import (
    ComponentFailed,
    ConfigError,
    Declined,
    IbrobotError,
    MissingDependency,
    PlanCode,
    PlanningError,
    PluginNotInstalled,
    Problem,
)

MADE = (
    ConfigError([Problem("robot.yaml", 7, "simulation.type", "there is no 'reach'")] * 60),
    PluginNotInstalled("hardware", "reach", "ibrobot-plugin-reach"),
    MissingDependency("OpenGL", apt=("libegl1",)),
    PlanningError("too far", PlanCode.NO_IK_SOLUTION),
    ComponentFailed("killed", 3),
    Declined(),
)


def every_error() -> Iterator[IbrobotError]:
    """One error of each class."""
    made: dict[type[IbrobotError], IbrobotError] = {type(each): each for each in MADE}
    for kind in vars(errors).values():
        if isinstance(kind, type) and issubclass(kind, IbrobotError):
            yield made.get(kind) or kind("why")


@pytest.mark.parametrize("error", list(every_error()), ids=lambda error: type(error).__name__)
def test_errors_cross_processes(error: IbrobotError) -> None:
    here, there = Pipe()
    with here, there:
        here.send(error)
        sent = there.recv()
    for arrived in (sent, copy.copy(error)):
        assert type(arrived) is type(error)
        assert str(arrived) == str(error)
        assert vars(arrived) == vars(error)
        assert arrived.exit_code == error.exit_code
