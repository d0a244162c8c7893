"""`ibrobot param list|get|set`: parameters of robots and ROS 2 nodes on the network."""

from __future__ import annotations

from typing import Any

import click
from ibrobot_ros2.interfaces import ServiceType, service_type

from ibrobot_core.api import NotSupported, TransportError
from ibrobot_core.app import dump_yaml, echo, parse_yaml
from ibrobot_zenoh.commands.network import Network, on_network
from ibrobot_zenoh.ros2 import absolute
from ibrobot_zenoh.ros_parameters import ParameterType, from_parameter, to_parameter
from ibrobot_zenoh.transport import ZenohTransport

_ANSWER_S = 5.0
_LIST = "list_parameters"


@click.group()
def param() -> None:
    """List, read and set parameters of nodes on the network."""


def _ask(transport: ZenohTransport, node: str, name: str, request: dict[str, Any]) -> dict[str, Any]:
    word = name.split("_", maxsplit=1)[0].capitalize()
    kind: ServiceType = service_type(f"rcl_interfaces/srv/{word}Parameters")
    return transport.call_ros(f"{absolute(node)}/{name}", kind, request, _ANSWER_S)


@param.command(name="list")
@on_network
@click.argument("node", required=False)
@click.option("--param-prefixes", "prefixes", multiple=True, metavar="PREFIX", help="List only these, e.g. control.")
@click.option("--param-type", "typed", is_flag=True, help="Show the types, too.")
def list_(network: Network, node: str | None, prefixes: tuple[str, ...], typed: bool) -> None:
    """List the parameters of NODE, or of all nodes."""
    with network as transport:
        nodes = [absolute(node)] if node else _nodes(transport)
        for each in nodes:
            names = _ask(transport, each, _LIST, {"prefixes": list(prefixes)})["result"]["names"]
            types = _ask(transport, each, "get_parameters", {"names": names})["values"] if typed else []
            if not node:
                echo(f"{each}:")
            for i, name in enumerate(names):
                kind = f" (type: {ParameterType(types[i]['type']).name.lower().replace('_', ' ')})" if typed else ""
                echo(f"  {name}{kind}")


def _nodes(transport: ZenohTransport) -> list[str]:
    """The nodes that have parameters."""
    services = transport.shared_services()
    return [
        each.name.removesuffix(f"/{_LIST}") for each in services if each.name.endswith(f"/{_LIST}") and each.servers
    ]


@param.command()
@on_network
@click.argument("node")
@click.argument("name", metavar="PARAMETER")
@click.option("--hide-type", is_flag=True, help="Show only the value.")
def get(network: Network, node: str, name: str, hide_type: bool) -> None:
    """Show the value of a PARAMETER of NODE."""
    with network as transport:
        (found,) = _ask(transport, node, "get_parameters", {"names": [name]})["values"]
    kind, value = ParameterType(found["type"]), from_parameter(found)
    if kind is ParameterType.NOT_SET:
        raise NotSupported(f"{absolute(node)} has no parameter {name}, or it is not set; ibrobot param list shows them")
    text = value if isinstance(value, str) else dump_yaml(value).removesuffix("...\n").strip()
    label = f"{kind.name.replace('_', ' ').capitalize()} value{'s are' if isinstance(value, list) else ' is'}: "
    echo(text if hide_type else label + text)


@param.command(name="set")
@on_network
@click.argument("node")
@click.argument("name", metavar="PARAMETER")
@click.argument("text", metavar="VALUE")
def set_(network: Network, node: str, name: str, text: str) -> None:
    """Set a PARAMETER of NODE to VALUE, as YAML."""
    document = parse_yaml(text, "VALUE")
    document.raise_problems()
    parameter = {"name": name, "value": to_parameter(document.root)}
    with network as transport:
        (result,) = _ask(transport, node, "set_parameters", {"parameters": [parameter]})["results"]
    if not result["successful"]:
        raise TransportError(f"{absolute(node)}: {name} cannot be set: {result['reason']}")
    echo("Set parameter successful")
