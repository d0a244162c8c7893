"""Commands of the host: each is checked before it is executed, since it comes from another process."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, get_origin

from ibrobot_core.control.phase import PERMITTED, Phase
from ibrobot_core.errors import HardwareError

Act = Callable[..., Mapping[str, Any] | None]
"""Executes a command; its parameters are the command's arguments, of classes or `Mapping`."""


def permitted(acts: Mapping[str, Act], do: object, arguments: Mapping[str, Any], phase: Phase, fault: str) -> Act:
    """The function that executes the command `do` with these arguments.

    Raises:
        HardwareError: if there is no such command, the phase does not permit it, or its arguments are others.
    """
    act = acts.get(do) if isinstance(do, str) else None
    if act is None:
        raise HardwareError(f"control has no command {do!r:.40}")
    if do not in PERMITTED[phase]:
        cause = f": {fault}" if phase is Phase.FAULTED else ""
        raise HardwareError(f"{do}: refused {phase.value}{cause}")
    signature = inspect.signature(act, eval_str=True)
    try:
        signature.bind(**arguments)
    except TypeError as error:
        raise HardwareError(f"malformed command: {error}") from None
    for name, value in arguments.items():
        kind = signature.parameters[name].annotation
        if not isinstance(value, get_origin(kind) if get_origin(kind) is Mapping else kind):
            raise HardwareError(f"malformed command: {name} cannot be a {type(value).__name__}")
    return act
