"""What core itself offers, as plugins do: executor `position`, engine `monolithic`, and `local` for no transport."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from ibrobot_core.descriptors import EngineDescriptor, ExecutorDescriptor, TransportDescriptor
from ibrobot_core.errors import NotSupported
from ibrobot_core.executor_options import PositionOptions
from ibrobot_core.hookspecs import hookimpl

if TYPE_CHECKING:
    from ibrobot_core.interfaces import Context, Engine, Executor, Transport


def _position(options: Any, ctx: Context) -> Executor:
    from ibrobot_core.control.position import PositionExecutor

    return PositionExecutor(options, ctx)


def _monolithic(options: Any, ctx: Context) -> Engine:
    from ibrobot_core.inference.engine import LocalEngine

    assert ctx.model is not None
    return LocalEngine(ctx.model.policy)


def _local(options: Any, ctx: Context) -> Transport:
    raise NotSupported("transport local leads nowhere: a run with it stays in this process, and asks for none")


@hookimpl
def ibrobot_executors() -> Iterable[ExecutorDescriptor]:
    """The one that policies and teleoperation need."""
    yield ExecutorDescriptor(
        type="position", options=PositionOptions, make=_position, streams=True,
        summary="follows a stream of setpoints; holds when it goes stale",
    )  # fmt: skip


@hookimpl
def ibrobot_engines() -> Iterable[EngineDescriptor]:
    """In the host."""
    yield EngineDescriptor(type="monolithic", make=_monolithic, summary="in the host process")


@hookimpl
def ibrobot_transports() -> Iterable[TransportDescriptor]:
    """The word for none."""
    yield TransportDescriptor(type="local", make=_local, summary="none: everything stays in this process")
