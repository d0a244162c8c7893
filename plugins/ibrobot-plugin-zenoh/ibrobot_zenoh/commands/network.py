"""Selects the network of a command: that of a robot YAML, or of an endpoint."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import attrs

from ibrobot_core.api import Context, NotSupported, RealClock, Robot, TransportError, option
from ibrobot_core.app import RequestError
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

_CONNECT_S = 3.0
"""How long a command waits for the other side [s]."""
_EVERYWHERE = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}
"""All addresses to listen on -> the one to reach such a server from this machine."""


@attrs.frozen(kw_only=True)
class OnNetwork:
    """The options that select the network."""

    config: str | None = option(
        None, typed="--config CONFIG", names="robot", help="the robot YAML whose transport section to use"
    )
    endpoints: tuple[str, ...] = option((), typed="--endpoint URL", help="e.g. tcp/127.0.0.1:7447")
    domain: int | None = option(None, ge=0, le=232, help="ROS 2 domain; by default the YAML's, or 0")

    def network(self) -> AbstractContextManager[ZenohTransport]:
        """A context with a connected transport."""
        return _connected(options_from(self.config, self.endpoints, self.domain))


def options_from(config: str | None, endpoints: tuple[str, ...], domain: int | None) -> ZenohOptions:
    """Transport options of a client on the network.

    Raises:
        RequestError: if no network is given, or the endpoint is invalid.
        NotSupported: if the YAML uses another transport.
    """
    if config is None and not endpoints:
        raise RequestError("no network: give --config CONFIG, or --endpoint, e.g. --endpoint tcp/127.0.0.1:7447")
    changes: dict[str, Any] = {} if domain is None else {"domain": domain}
    if config is None:
        try:
            return ZenohOptions(connect=endpoints, **changes)
        except ValueError as error:
            reason = "certificates are given by --config" if "needs tls" in str(error) else error
            raise RequestError(f"--endpoint: {reason}") from None
    from ibrobot_core.app import find_config, installed_plugins, load_config

    robot = load_config(find_config(config, installed_plugins()), communicates=True)
    if robot.transport is None or not isinstance(robot.transport.options, ZenohOptions):
        kind = "no transport" if robot.transport is None else f"transport {robot.transport.type}"
        raise NotSupported(f"{robot.source}: has {kind}; topics are shared by transport: {{type: zenoh, …}}")
    options = robot.transport.options
    connect = endpoints or options.connect or tuple(_here(endpoint) for endpoint in options.listen)
    return attrs.evolve(options, mode="client", connect=connect, listen=(), users=None, namespace="", **changes)


def _here(endpoint: str) -> str:
    for everywhere, here in _EVERYWHERE.items():
        endpoint = endpoint.replace(f"/{everywhere}:", f"/{here}:")
    return endpoint


@contextmanager
def _connected(options: ZenohOptions) -> Iterator[ZenohTransport]:
    """The network.

    Raises:
        TransportError: if there is no answer.
    """
    log = logging.getLogger("ibrobot.topic")
    log.setLevel(logging.ERROR)  # the error has the reason
    transport = ZenohTransport(options, Context("topic", RealClock(), log, Robot("command_line", ())))
    try:
        if not transport.connection.answered.wait(_CONNECT_S):
            raise TransportError(f"not connected: {transport.connection.why_not}")
        yield transport
    finally:
        transport.close()
