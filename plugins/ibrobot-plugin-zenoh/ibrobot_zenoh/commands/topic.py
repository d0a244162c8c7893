"""`ibrobot topic list|echo|hz|pub`: topics that are shared over the network."""

from __future__ import annotations

import itertools
import queue
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import wraps
from itertools import pairwise
from typing import Any

import attrs
import click
import numpy as np

from ibrobot_core.api import MESSAGE_TYPES, Message, NotSupported, TransportError, did_you_mean
from ibrobot_core.app import dump_yaml, echo, single_options
from ibrobot_zenoh.commands.network import Network, on_network
from ibrobot_zenoh.ros2 import HIDDEN
from ibrobot_zenoh.transport import ZenohTransport

_HEARD_S = 1.0
"""How long `pub` waits for a subscriber [s]."""
_SHOWN = 16
"""Number of array elements to show."""


@click.group()
def topic() -> None:
    """List, show, measure and publish topics that robots and ROS 2 nodes share over the network."""


def _command(function: Callable[..., None]) -> click.Command:
    """Make a command of `topic` whose function receives a connected transport, and which Ctrl-C ends."""

    @wraps(function)
    def run(network: Network, **arguments: Any) -> None:
        with suppress(KeyboardInterrupt), network as transport:
            function(transport, **arguments)

    return topic.command(function.__name__.rstrip("_"))(on_network(run))


@_command
@click.option(
    "-t",
    "--types",
    "--show-types",
    is_flag=True,
    help="Show message types and the numbers of publishers and subscribers.",
)
def list_(transport: ZenohTransport, types: bool) -> None:
    """List the shared topics."""
    shared = [each for each in transport.shared_topics() if HIDDEN not in each.name]
    if not shared:
        echo("no topics are shared", err=True)
    for each in shared:
        counts = f"  {each.type}  published by {each.publishers}, heard by {each.subscribers} ROS 2 nodes"
        echo(f"{each.name}{counts if types else ''}")


@_command
@click.argument("name", metavar="TOPIC")
@click.option("--count", "-n", type=click.IntRange(1), help="Stop after this many messages.")
@click.option("--once", is_flag=True, help="Stop after the first message.")
@click.option("-f", "--full", "--full-length", is_flag=True, help="Show all elements of arrays.")
def echo_(transport: ZenohTransport, name: str, count: int | None, once: bool, full: bool) -> None:
    """Show the messages on TOPIC, until Ctrl-C."""
    arrived: queue.SimpleQueue[Message] = queue.SimpleQueue()
    transport.subscribe_messages(name, arrived.put)
    _warn_if_unpublished(transport, name)
    for _ in _counted(1 if once else count):
        echo(f"{shown(arrived.get(), full=full)}---")


@_command
@click.argument("name", metavar="TOPIC")
@click.option("--count", "-n", type=click.IntRange(1), help="Stop after this many measurements.")
@click.option(
    "--period", default=1.0, show_default=True, type=click.FloatRange(0.01), help="Duration of a measurement [s]."
)
def hz(transport: ZenohTransport, name: str, count: int | None, period: float) -> None:
    """Measure the rate of messages on TOPIC, until Ctrl-C."""
    arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
    transport.subscribe_messages(name, lambda message: arrived.put(time.monotonic()))
    _warn_if_unpublished(transport, name)
    last: float | None = None
    for _ in _counted(count):
        times = [last] if last is not None else []
        deadline = time.monotonic() + period
        while (left := deadline - time.monotonic()) > 0:
            with suppress(queue.Empty):
                times.append(arrived.get(timeout=left))
        gaps = [after - before for before, after in pairwise(times)]
        last = times[-1] if times else None
        if not gaps:
            echo(f"fewer than two messages on {name} in {period:g} s")
            continue
        rate = len(gaps) / sum(gaps)
        echo(f"{rate:.2f} Hz, gaps {min(gaps) * 1e3:.1f} to {max(gaps) * 1e3:.1f} ms, {len(gaps)} messages")


@_command
@click.argument("name", metavar="TOPIC")
@click.argument("type_name", metavar="TYPE")
@click.argument("text", metavar="MESSAGE")
@click.option("-r", "--rate", type=click.FloatRange(0.01, 1000), help="Publish at this rate [Hz], until Ctrl-C.")
@click.option(
    "-t",
    "--times",
    "--count",
    "-n",
    "count",
    type=click.IntRange(1),
    help="Stop after this many messages; 1 Hz without --rate.",
)
@click.option("-1", "--once", is_flag=True, help="Publish one message, as without --rate and --times.")
@click.option(
    "-w", "--wait-matching-subscriptions", "wait", is_flag=True, help="Wait for a subscriber before publishing."
)
def pub(
    transport: ZenohTransport, name: str, type_name: str, text: str, rate: float | None, count: int | None,
    once: bool, wait: bool,
) -> None:  # fmt: skip
    """Publish MESSAGE, as YAML, on TOPIC: once, or repeatedly.

    E.g. `ibrobot topic pub /lamp std_msgs/msg/Bool '{data: true}'`.
    """
    if once and (rate is not None or count is not None):
        raise click.UsageError("--once excludes --rate and --times")
    if count is not None and rate is None:
        rate = 1.0
    message = message_from(type_name, text)
    known = {each.type for each in transport.shared_topics() if each.name == name and each.publishers}
    if known - {message.ros_type}:
        raise TransportError(f"topic {name} carries {', '.join(sorted(known))}, not {message.ros_type}")
    while not (heard := transport.is_heard(name, message.ros_type, _HEARD_S)) and wait:
        pass
    if not heard:
        echo(f"{name} has no subscriber yet", err=True)
    due = time.monotonic()
    for _ in _counted(1 if rate is None else count):
        transport.publish_message(name, message)
        if rate is not None:
            due += 1 / rate
            time.sleep(max(0.0, due - time.monotonic()))


def _warn_if_unpublished(transport: ZenohTransport, name: str) -> None:
    """Warn if a topic has no publisher."""
    published = [each.name for each in transport.shared_topics() if each.publishers]
    if name not in published:
        echo(f"{name} has no publisher yet; available: {', '.join(published) or 'none'}", err=True)


def _counted(count: int | None) -> Iterator[int]:
    """Count to `count`, or without end."""
    return iter(range(count)) if count is not None else itertools.count()


def shown(message: Message, *, full: bool) -> str:
    """A message as YAML; long arrays are truncated unless `full`."""
    return dump_yaml(_plain(message, full))


def _plain(value: Any, full: bool) -> Any:
    if attrs.has(type(value)):
        return {field.name: _plain(getattr(value, field.name), full) for field in attrs.fields(type(value))}
    if isinstance(value, np.ndarray):
        if full or value.size <= _SHOWN:
            return value.tolist()
        return [*value.ravel()[:_SHOWN].tolist(), f"… {value.size - _SHOWN} more"]
    if isinstance(value, (list, tuple)):
        return [_plain(item, full) for item in value]
    return value


def message_from(type_name: str, text: str) -> Message:
    """Parse a message from YAML, e.g. `{data: true}`.

    Raises:
        NotSupported: if the type cannot be written in this way.
        ConfigError: with all errors in the text.
    """
    kind = MESSAGE_TYPES.get(type_name)
    if kind is None:
        hint = did_you_mean(type_name, list(MESSAGE_TYPES), "the types are")
        raise NotSupported(f"{type_name!r} is not a type that can be published{hint}")
    return single_options(kind, (), "MESSAGE", text=text)
