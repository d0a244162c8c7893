"""The plugin's hooks: the engines `process` and `distributed`, and the command `ibrobot serve`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import EngineDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_serve.options import DistributedOptions, ProcessOptions

if TYPE_CHECKING:
    import click

    from ibrobot_core.api import Context, Engine


def _process(options: Any, ctx: Context) -> Engine:
    from ibrobot_serve.process import ProcessEngine

    return ProcessEngine.from_context(options, ctx)


def _distributed(options: Any, ctx: Context) -> Engine:
    from ibrobot_serve.remote import RemoteEngine

    return RemoteEngine.from_context(options, ctx)


def _serve() -> click.Command:
    from ibrobot_serve.command import serve

    return serve


@hookimpl
def ibrobot_engines() -> Iterable[EngineDescriptor]:
    """Engines that run the model in another process or on a server."""
    yield EngineDescriptor(type="process", make=_process, summary="in a process of its own", options=ProcessOptions)
    yield EngineDescriptor(
        type="distributed",
        make=_distributed,
        summary="on a server",
        options=DistributedOptions,
        uses_transport=True,
        weights_here=False,
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot serve`."""
    yield Command("serve", "Run a model for robots on other machines.", _serve)
