"""The plugin of core: its commands, executor `position`, engine `monolithic`, and the no-op transport `local`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import (
    Command,
    EngineDescriptor,
    ExecutorDescriptor,
    Late,
    StreamOptions,
    TransportDescriptor,
)
from ibrobot_core.errors import NotSupported
from ibrobot_core.hookspecs import hookimpl

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, Engine, Transport


def _monolithic(options: Any, ctx: Context) -> Engine:
    from ibrobot_core.inference.client import LocalEngine

    assert ctx.model is not None
    return LocalEngine(ctx.model.policy)


def _local(options: Any, ctx: Context) -> Transport:
    raise NotSupported("transport local connects to nothing: a run with it stays in this process")


@hookimpl
def ibrobot_executors() -> Iterable[ExecutorDescriptor]:
    """The executor for policies and teleoperation."""
    yield ExecutorDescriptor(
        type="position",
        options=StreamOptions,
        make=Late("ibrobot_core.control.position:PositionExecutor"),
        streams=True,
        summary="follows a stream of setpoints; holds when they go stale",
    )


@hookimpl
def ibrobot_engines() -> Iterable[EngineDescriptor]:
    """The engine that runs the model in the host process."""
    yield EngineDescriptor(type="monolithic", make=_monolithic, summary="in the host process")


@hookimpl
def ibrobot_transports() -> Iterable[TransportDescriptor]:
    """The transport of a run without other machines."""
    yield TransportDescriptor(type="local", make=_local, summary="none: everything stays in this process")


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Commands that need no other plugin."""
    yield Command("launch", Late("ibrobot_core.cli.launch:Launch"), "Run a robot, real or simulated.")
    about = "CONFIG is a file, or the name of a config shipped with ibrobot or a plugin; so101 by default."
    yield Command("config", summary="Check and show robot YAMLs.", about=about)
    yield Command("config check", Late("ibrobot_core.cli.config:CheckConfig"))
    yield Command("config show", Late("ibrobot_core.cli.config:ShowConfig"))
    summary = "Check this machine, and print a remedy for each fault."
    yield Command("doctor", Late("ibrobot_core.cli.doctor:Doctor"), summary)
