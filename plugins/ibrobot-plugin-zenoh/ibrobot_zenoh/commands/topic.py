"""`ibrobot topic list|echo|hz|pub`: topics that are shared over the network."""

from __future__ import annotations

import itertools
import queue
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from typing import Any, override

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_core.api import MESSAGE_TYPES, Message, NotSupported, TransportError, did_you_mean, option
from ibrobot_core.app import RequestError, dump_yaml, echo, single_options
from ibrobot_zenoh.commands.network import OnNetwork
from ibrobot_zenoh.ros2 import HIDDEN
from ibrobot_zenoh.transport import ZenohTransport

_HEARD_S = 1.0
"""How long `pub` waits for a subscriber [s]."""
_SHOWN = 16
"""Number of array elements to show."""


@attrs.frozen(kw_only=True)
class _OnTopics(OnNetwork):
    """A command for topics, which Ctrl-C ends."""

    def __call__(self) -> None:
        with suppress(KeyboardInterrupt), self.network() as transport:
            self._work(transport)

    def _work(self, transport: ZenohTransport) -> None:
        raise NotImplementedError


@attrs.frozen(kw_only=True)
class ListTopics(_OnTopics):
    """List the shared topics."""

    types: bool = option(
        False, typed="-t --show-types --types", help="show message types and the numbers of publishers and subscribers"
    )

    @override
    def _work(self, transport: ZenohTransport) -> None:
        shared = [each for each in transport.shared_topics() if HIDDEN not in each.name]
        if not shared:
            echo("no topics are shared", err=True)
        for each in shared:
            counts = f"  {each.type}  published by {each.publishers}, heard by {each.subscribers} ROS 2 nodes"
            echo(f"{each.name}{counts if self.types else ''}")


@attrs.frozen(kw_only=True)
class Echo(_OnTopics):
    """Show the messages on TOPIC, until Ctrl-C."""

    name: str = option(typed="TOPIC", help="the topic")
    count: int | None = option(None, typed="-n", ge=1, help="stop after this many messages")
    once: bool = option(False, help="stop after the first message")
    full: bool = option(False, typed="-f --full-length --full", help="show all elements of arrays")

    @override
    def _work(self, transport: ZenohTransport) -> None:
        arrived: queue.SimpleQueue[Message] = queue.SimpleQueue()
        transport.subscribe_messages(self.name, arrived.put)
        _warn_if_unpublished(transport, self.name)
        for _ in _counted(1 if self.once else self.count):
            echo(f"{shown(arrived.get(), full=self.full)}---")


@attrs.frozen(kw_only=True)
class Rate(_OnTopics):
    """Measure the rate of messages on TOPIC, until Ctrl-C."""

    name: str = option(typed="TOPIC", help="the topic")
    count: int | None = option(None, typed="-n", ge=1, help="stop after this many measurements")
    period: float = option(1.0, ge=0.01, unit="s", help="duration of a measurement")

    @override
    def _work(self, transport: ZenohTransport) -> None:
        arrived: queue.SimpleQueue[float] = queue.SimpleQueue()
        transport.subscribe_messages(self.name, lambda message: arrived.put(time.monotonic()))
        _warn_if_unpublished(transport, self.name)
        last: float | None = None
        for _ in _counted(self.count):
            times = [last] if last is not None else []
            deadline = time.monotonic() + self.period
            while (left := deadline - time.monotonic()) > 0:
                with suppress(queue.Empty):
                    times.append(arrived.get(timeout=left))
            gaps = [after - before for before, after in pairwise(times)]
            last = times[-1] if times else None
            if not gaps:
                echo(f"fewer than two messages on {self.name} in {self.period:g} s")
                continue
            rate = len(gaps) / sum(gaps)
            between = f"{min(gaps) * 1e3:.1f} to {max(gaps) * 1e3:.1f} ms"
            echo(f"{rate:.2f} Hz, gaps {between}, {counted(len(gaps), 'message')}")


@attrs.frozen(kw_only=True)
class Publish(_OnTopics):
    """Publish MESSAGE, as YAML, on TOPIC: once, or repeatedly.

    E.g. `ibrobot topic pub /lamp std_msgs/msg/Bool '{data: true}'`.
    """

    name: str = option(typed="TOPIC", help="the topic")
    type_name: str = option(typed="TYPE", help="its type, e.g. std_msgs/msg/Bool")
    text: str = option(typed="MESSAGE", help="the message, as YAML")
    rate: float | None = option(None, typed="-r", ge=0.01, le=1000, help="publish at this rate [Hz], until Ctrl-C")
    count: int | None = option(
        None, typed="-t -n --count --times", ge=1, help="stop after this many messages; 1 Hz without --rate"
    )
    once: bool = option(False, typed="-1", help="publish one message, as without --rate and --times")
    wait: bool = option(False, typed="-w --wait-matching-subscriptions", help="wait for a subscriber before publishing")

    @override
    def _work(self, transport: ZenohTransport) -> None:
        if self.once and (self.rate is not None or self.count is not None):
            raise RequestError("--once excludes --rate and --times")
        rate = 1.0 if self.count is not None and self.rate is None else self.rate
        message = message_from(self.type_name, self.text)
        known = {each.type for each in transport.shared_topics() if each.name == self.name and each.publishers}
        if known - {message.ros_type}:
            raise TransportError(f"topic {self.name} carries {', '.join(sorted(known))}, not {message.ros_type}")
        while not (heard := transport.is_heard(self.name, message.ros_type, _HEARD_S)) and self.wait:
            pass
        if not heard:
            echo(f"{self.name} has no subscriber yet", err=True)
        due = time.monotonic()
        for _ in _counted(1 if rate is None else self.count):
            transport.publish_message(self.name, message)
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
