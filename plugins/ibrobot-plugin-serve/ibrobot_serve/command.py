"""`ibrobot serve`: load a model, and answer robots with `execution_mode: distributed`."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import attrs
from ibrobot_http.probes import ProbeServer
from ibrobot_terminal.plural import counted

from ibrobot_core.api import Context, Policy, RealClock, Robot, Transport, TransportDescriptor, option
from ibrobot_core.app import (
    LogFormatter,
    Override,
    Registry,
    RequestError,
    RobotConfig,
    echo,
    find_config,
    installed_plugins,
    load_config,
    on_signals,
    read_document,
    single_options,
    wrong_input,
)
from ibrobot_serve.fleet import LARGEST_CANARY
from ibrobot_serve.metrics import probes
from ibrobot_serve.service import InferenceService, ServiceOptions

_LOG = logging.getLogger("ibrobot")
_PLAIN_PERIOD_S = 10.0
_PANEL_PERIOD_S = 0.5
_PORTS = {"openpi": 8000, "gr00t": 5555}
"""Protocols of other projects, with their usual ports."""


def _share(text: str) -> float:
    """Parse a percentage."""
    try:
        share = float(text.removesuffix("%")) / 100
    except ValueError:
        share = math.nan
    if not text.endswith("%") or not 0 <= share <= LARGEST_CANARY:
        raise RequestError(f"--canary: {text!r} is not a percentage from 0% to {LARGEST_CANARY:.0%}, e.g. 10%")
    return share


@attrs.frozen(kw_only=True)
class Serve:
    """Run a model for robots on other machines.

    CONFIG is a robot YAML, which names model and transport; MODEL_DIR is a folder with a model, for --type.
    Robots use it by `execution_mode: distributed`. Ctrl-C or SIGTERM answers pending requests, then ends.
    With --protocol openpi or gr00t, it answers clients of these projects, which must send the key in the environment
    variable IBROBOT_API_KEY, if that is set.
    """

    what: str = option(typed="CONFIG|MODEL_DIR", help="robot YAML, or folder with a model")
    model: str | None = option(None, help="name of the model in CONFIG; optional if it has only one")
    sim: bool = option(False, help="read CONFIG as for a simulation: its hardware plugins are not needed")
    type_: str | None = option(None, typed="--type", help="plugin of the policy in MODEL_DIR, e.g. lerobot")
    name: str | None = option(None, help="name of the model for robots; by default its name in CONFIG, or the folder's")
    overrides: tuple[str, ...] = option(
        (),
        typed="--set PATH=VALUE",
        help="override a key of CONFIG, e.g. control.rate_hz=50, or an option of the policy in MODEL_DIR, "
        "e.g. device=cpu",
    )
    listen: tuple[str, ...] = option(
        (),
        typed="--listen ENDPOINT",
        help="address for robots, in place of the transport's connect; with MODEL_DIR, by default this machine",
    )
    transport_options: tuple[str, ...] = option(
        (), typed="--transport OPTION=VALUE", help="option of the transport, e.g. users=users.txt"
    )
    batch: int = option(8, ge=1, help="maximum requests per batch")
    queue: int = option(64, ge=1, help="maximum waiting requests")
    patience: float = option(0.0, ge=0, le=1000, unit="ms", help="how long an incomplete batch waits for more requests")
    hang_timeout: float = option(
        30.0,
        gt=0,
        unit="s",
        help="a model that works on one batch for longer counts as hanging: requests fail, and the server restarts",
    )
    canary: str = option(
        "0%",
        typed="--canary SHARE",
        help="share of all robots that try this server although its weights differ, up to 50%; 0%: none",
    )
    metrics_port: int | None = option(
        None,
        typed="--metrics-port PORT",
        ge=0,
        le=65535,
        help="port of 127.0.0.1 for /metrics (Prometheus), /healthz and /readyz; 0: any free port",
    )
    drain: float = option(10.0, ge=0, unit="s", help="how long to wait for pending requests at the end")
    protocol: str = option(
        "ibrobot",
        choices=("ibrobot", *_PORTS),
        help="protocol of the clients; for openpi and gr00t, --listen is HOST:PORT, by default on this machine",
    )

    def __call__(self) -> None:
        registry = installed_plugins()
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(LogFormatter("%(levelname).1s %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
        _LOG.setLevel(logging.INFO)
        if self.protocol in _PORTS:
            _serve_clients(self, registry)
            return
        with wrong_input():
            name, policy, make_transport = _from_folder(self, registry) if self.type_ else _from_config(self, registry)
        hung = threading.Event()
        with _loaded(policy, name) as stopping, ExitStack() as ending:

            def replace() -> None:
                hung.set()
                stopping.set()

            ending.callback(lambda: _start_again() if hung.is_set() else None)  # closing the policy could hang as well
            transport = make_transport()
            ending.callback(transport.close)
            limits = ServiceOptions(
                self.batch, self.queue, self.patience / 1000, self.hang_timeout,
                canary=_share(self.canary),
            )  # fmt: skip
            service = InferenceService(policy, transport, name, limits, policy.picture_codec(), replace)
            with ExitStack() as answering:
                answering.callback(service.close)
                service.start()
                some = f" for {limits.canary:.0%} of the robots" if limits.canary else ""
                _LOG.info("server %s of %s%s", service.id, name, some)
                if self.metrics_port is not None:
                    metrics = answering.enter_context(closing(ProbeServer(self.metrics_port, probes(service))))
                    _LOG.info("metrics on %s", metrics.url)
                echo(f"serving {name} (policy {policy.fingerprint()}); Ctrl-C ends")
                _show(service, stopping)
                if not hung.is_set() and not service.drain(self.drain):
                    _LOG.warning("pending requests were not answered in time")
            echo(_line(service.statistics()))


@contextmanager
def _loaded(policy: Policy, name: str) -> Iterator[threading.Event]:
    """A context with a loaded policy; a signal sets the event."""
    try:
        begun_s = time.monotonic()
        policy.load()
        _LOG.info("%s loaded in %.1f s", name, time.monotonic() - begun_s)
        stopping = threading.Event()  # from here on; before, either signal ends the process at once
        on_signals(stopping.set)
        yield stopping
    finally:
        policy.close()


def _start_again() -> None:
    """Replace this process by one with the same command line: nothing else ends a hanging thread."""
    _LOG.error("the server restarts, with the same command line")
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _from_config(options: Serve, registry: Registry) -> tuple[str, Policy, Callable[[], Transport]]:
    """Name, policy and transport of a robot YAML."""
    if Path(options.what).is_dir():
        raise RequestError(f"{options.what} is a folder: name the plugin of its model, e.g. --type lerobot")
    path = find_config(options.what, registry)
    transport = _transport_type(path, options.overrides)
    endpoints = options.listen if transport else ()
    listening = _listening(registry, transport, endpoints, "transport.") if endpoints else []
    given = [Override.of(f"--transport {each}", f"transport.{each}") for each in options.transport_options]
    changes = (*options.overrides, *listening, *given)
    config = load_config(path, overrides=changes, sim=options.sim, registry=registry, communicates=True)
    served, section = _of_config(options, config, path, registry), config.transport
    if section is None or section.type == "local":
        raise RequestError(
            f"{path} names no transport to robots: add "
            f"--set 'transport={{type: {next(iter(registry.official('transport')))}}}' --listen ENDPOINT"
        )
    make = partial(registry.find("transport", section.type).make, section.options, _context(config.robot))
    return *served, make


def _from_folder(options: Serve, registry: Registry) -> tuple[str, Policy, Callable[[], Transport]]:
    """Name, policy and transport of a folder with a model."""
    name, policy, context = _of_folder(options, registry)
    transport = registry.default("transport")
    transports = registry.find("transport", transport)
    given = [*_listening(registry, transport, options.listen), *options.transport_options]
    settings = single_options(transports.options, given, "--listen, --transport", "--transport")
    return name, policy, partial(transports.make, settings, context)


def _of_folder(options: Serve, registry: Registry) -> tuple[str, Policy, Context]:
    """Name and policy of a folder with a model, and the context for its transport."""
    folder = Path(options.what)
    if not folder.is_dir():
        raise RequestError(f"{folder}: no such folder; with --type, give a folder with a model")
    if options.model:
        raise RequestError("--model selects a model of CONFIG; MODEL_DIR has only one, which --name names")
    context = _context(Robot("server", ()))
    policies = registry.find("policy", options.type_ or "")
    overrides = [f"path={folder.absolute()}", *options.overrides]
    parsed = single_options(policies.options, overrides, str(folder))
    policy = registry.create("policy", policies.type, parsed, context)
    return options.name or folder.absolute().name, policy, context


def _of_config(options: Serve, config: RobotConfig, path: Path, registry: Registry) -> tuple[str, Policy]:
    """Name and policy of the model to serve."""
    model: str = options.model or (next(iter(config.models)) if len(config.models) == 1 else "")
    if model not in config.models:
        raise RequestError(f"--model: one of {', '.join(config.models) or 'none'} in {path}, got {options.model}")
    return options.name or model, registry.build_policy(config, model)


def _serve_clients(options: Serve, registry: Registry) -> None:
    """Answer clients of another project until a signal."""
    from ibrobot_serve.client_model import ClientModel
    from ibrobot_serve.gr00t_server import Gr00tServer
    from ibrobot_serve.openpi_server import OpenpiServer

    key, protocol = os.environ.get("IBROBOT_API_KEY") or None, options.protocol
    host, port = _host_and_port(options.listen, key, _PORTS[protocol])
    with wrong_input():
        if options.type_:
            name, policy, _ = _of_folder(options, registry)
        else:
            path = find_config(options.what, registry)
            config = load_config(path, overrides=options.overrides, sim=options.sim, registry=registry)
            name, policy = _of_config(options, config, path, registry)
    with _loaded(policy, name) as stopping:
        with wrong_input():
            try:
                model = ClientModel(policy, name, protocol)
                kind = OpenpiServer if protocol == "openpi" else Gr00tServer
                server: OpenpiServer | Gr00tServer = kind(model, host, port, key)
            except OSError as error:
                raise RequestError(f"--listen: {host}:{port} cannot be used: {error.strerror}") from None
        with closing(server):
            scheme = "ws" if protocol == "openpi" else "tcp"
            echo(f"serving {name} to clients of {protocol} on {scheme}://{host}:{server.port}; Ctrl-C ends")
            stopping.wait()
        echo(f"{model.answered} answered, {model.failed} failed")


def _host_and_port(listen: Sequence[str], key: str | None, usual: int = 8000) -> tuple[str, int]:
    """The address of a server for clients of another project; `usual` is its usual port.

    Raises:
        RequestError: if it is not one HOST:PORT, or others could use the model without a key.
    """
    given = listen or (f"127.0.0.1:{usual}",)
    host, _, port = given[0].rpartition(":")
    if len(given) != 1 or not host or not port.isdecimal() or int(port) > 65535:
        raise RequestError(f"--listen: {' '.join(given)!r} must be one HOST:PORT, e.g. 127.0.0.1:8000")
    if key is None and host not in ("127.0.0.1", "localhost", "::1"):
        raise RequestError(
            f"--listen: other machines could use the model at {host} without a password: set IBROBOT_API_KEY, which "
            "clients then need as their api_key"
        )
    return host, int(port)


def _transport_type(path: Path, overrides: Sequence[str]) -> str:
    """The type in the `transport` section, read before any checks; empty if there is none."""
    document = read_document(path, overrides)
    type_name = str(document.get("transport", "type") or "")
    return "" if type_name == "local" else type_name


def _listening(registry: Registry, transport: str, endpoints: Sequence[str], section: str = "") -> list[str]:
    """Overrides of a transport's options, below `section`, for a server that listens."""
    descriptor = registry.find("transport", transport)
    if not isinstance(descriptor, TransportDescriptor) or descriptor.listen is None:
        raise RequestError(f"--listen: a server cannot listen with transport {transport!r}")
    typed = " ".join(f"--listen {each}" for each in endpoints)
    options = descriptor.listen(endpoints)
    return [Override.of(typed, f"{section}{option}={json.dumps(value)}") for option, value in options.items()]


def _context(robot: Robot) -> Context:
    return Context("serve", RealClock(), logging.getLogger("ibrobot.serve"), robot)


def _show(service: InferenceService, stopping: threading.Event) -> None:
    """Show the statistics until `stopping` is set: as a table in a terminal, otherwise as a line every ten seconds."""
    if not sys.stdout.isatty():
        while not stopping.wait(_PLAIN_PERIOD_S):
            echo(_line(service.statistics()))
        return
    from ibrobot_terminal.screen import Screen
    from rich.live import Live

    with Live(console=Screen(), auto_refresh=False) as display:
        while not stopping.wait(_PANEL_PERIOD_S):
            display.update(_table(service.statistics()), refresh=True)


def _line(statistics: dict[str, Any]) -> str:
    return (
        counted(statistics["requests"], "request")
        + ", {answered} answered, {expired} expired, {malformed} malformed, {waiting} waiting | "
        "latency p50 {latency_p50_ms:.1f} ms, p99 {latency_p99_ms:.1f} ms | ".format_map(statistics)
        + counted(len(statistics["robots"]), "robot")
    )


def _table(statistics: dict[str, Any]) -> Any:
    from rich.table import Table

    table = Table(title=f"{statistics['model']}: {_line(statistics)}")
    for heading in ("robot", "requests", "answered", "expired", "failed", "p50 ms", "p99 ms"):
        table.add_column(heading, justify="left" if heading == "robot" else "right")
    for robot, counts in statistics["robots"].items():
        numbers = ("requests", "answered", "expired", "failed", "latency_p50_ms", "latency_p99_ms")
        table.add_row(robot, *(str(counts[number]) for number in numbers))
    return table
