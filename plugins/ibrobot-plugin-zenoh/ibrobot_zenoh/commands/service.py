"""`ibrobot service list|show|call`: services that a robot shares over the network."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import click
from ibrobot_ros2.interfaces import service_type
from ibrobot_ros2.services import DETAILS, SERVICES, Call, decode_answer, encode_call, endpoint

from ibrobot_core.api import NotSupported, TransportError
from ibrobot_core.app import dump_yaml, echo, parse_yaml
from ibrobot_zenoh.commands.network import Network, on_network
from ibrobot_zenoh.ros2 import HIDDEN, absolute
from ibrobot_zenoh.transport import ZenohTransport

_TYPE = re.compile(r"\w+/srv/\w+")


@click.group()
def service() -> None:
    """List, show and call services that a robot shares over the network."""


def _command(function: Callable[..., None]) -> click.Command:
    """Make a command of `service` whose function receives the network and the robot's namespace."""
    named = click.option("--namespace", default="", metavar="NAME", help="The robot's namespace, e.g. arm1.")(function)
    return service.command(function.__name__.rstrip("_"))(on_network(named))


def _ask(transport: ZenohTransport, namespace: str, call: Call, timeout_s: float) -> Any:
    answer = decode_answer(transport.request(endpoint(namespace), encode_call(call), timeout_s))
    if not answer.result:
        raise NotSupported(str(answer.values))
    return answer.values


@_command
@click.option("-t", "--show-types", "typed", is_flag=True, help="Show types: those that ROS 2 nodes can call have one.")
def list_(network: Network, namespace: str, typed: bool) -> None:
    """List the services of the robot, and of ROS 2 nodes."""
    with network as transport:
        types = {each.name: each.type for each in transport.shared_services() if each.servers}
        try:
            own = _ask(transport, namespace, Call(SERVICES), 5.0)
        except TransportError:
            if not types:
                raise
            own = []  # the network has ROS 2 nodes alone
    shown = {name for name in types if HIDDEN not in name}  # as in ros2: not those of actions
    for name in sorted({*own, *shown}):
        echo(f"{name} [{types[name]}]" if typed and name in types else name)


@_command
@click.argument("name", metavar="SERVICE")
def show(network: Network, namespace: str, name: str) -> None:
    """Show what SERVICE does, its request and its answer."""
    with network as transport:
        details = _ask(transport, namespace, Call(DETAILS, name), 5.0)
    echo(f"{name}: {details['help']}")
    echo("request:" if details["request"] else "request: none")
    for key in details["request"]:
        echo(f"  {_key_line(key)}")
    if details["alone"]:
        echo(f"A request without keys is the {details['alone']}.")
    echo(f"answer: {details['answer']}")
    for key in details["answer_keys"]:
        echo(f"  {_key_line(key)}")


def _key_line(key: Mapping[str, Any]) -> str:
    """A key of a request or an answer."""
    unit = f" [{key['unit']}]" if key["unit"] else ""
    default = "" if key["required"] else f"; by default {json.dumps(key['default'], default=str)}"
    allowed = f" ({key['allowed']})" if key["allowed"] else ""
    return f"{key['name']}: {key['type']}{unit}{allowed}{f': {key["help"]}' if key['help'] else ''}{default}"


@_command
@click.argument("name", metavar="SERVICE")
@click.argument("words", metavar="[TYPE] [REQUEST]", nargs=-1)
@click.option("--timeout", default=60.0, show_default=True, type=click.FloatRange(0.01), help="Longest wait [s].")
@click.option("--text", is_flag=True, help="Send REQUEST as text, unparsed.")
def call(network: Network, namespace: str, name: str, words: tuple[str, ...], timeout: float, text: bool) -> None:
    """Call SERVICE with REQUEST, as YAML, and print the answer.

    E.g. `ibrobot service call /planning/go_to home` or `… /world/remove '{name: can}'`. With TYPE, it calls a service
    of a ROS 2 node, or of a robot under that type, e.g. `… /estop std_srvs/srv/Trigger`.
    """
    is_ros = bool(words) and _TYPE.fullmatch(words[0]) is not None
    if len(words) > 1 + is_ros:
        raise click.UsageError(f"got {len(words)} words after {name}; quote REQUEST")
    request = words[is_ros] if len(words) > is_ros else "null"
    value: Any = request
    if not text:
        document = parse_yaml(request, "REQUEST")
        document.raise_problems()
        value = document.root
    with network as transport:
        if is_ros:
            full = absolute(name, namespace)
            answer: Any = transport.call_ros(full, service_type(words[0]), value or {}, timeout)
        else:
            answer = _ask(transport, namespace, Call(name, value), timeout)
    if answer is not None:
        echo(dump_yaml(answer).removesuffix("\n") if isinstance(answer, dict | list) else str(answer))
