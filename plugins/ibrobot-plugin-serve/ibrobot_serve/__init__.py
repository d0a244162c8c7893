"""The plugin's hooks: the engines `process` and `distributed`, and the command `ibrobot serve`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import EngineDescriptor, Late, hookimpl
from ibrobot_core.app import Command
from ibrobot_serve.options import DistributedOptions, ProcessOptions


@hookimpl
def ibrobot_engines() -> Iterable[EngineDescriptor]:
    """Engines that run the model in another process or on a server."""
    yield EngineDescriptor(
        type="process",
        make=Late("ibrobot_serve.process:ProcessEngine.from_context"),
        summary="in a process of its own",
        options=ProcessOptions,
    )
    yield EngineDescriptor(
        type="distributed",
        make=Late("ibrobot_serve.remote:RemoteEngine.from_context"),
        summary="on a server",
        options=DistributedOptions,
        uses_transport=True,
        weights_here=False,
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot serve`."""
    yield Command("serve", Late("ibrobot_serve.command:Serve"), "Run a model for robots on other machines.")
