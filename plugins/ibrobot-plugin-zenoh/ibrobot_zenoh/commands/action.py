"""`ibrobot action list|send`: actions of robots and ROS 2 nodes on the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click
from ibrobot_ros2.interfaces import action_type

from ibrobot_core.api import NotSupported, TransportError
from ibrobot_core.app import dump_yaml, echo, parse_yaml, wrong_input
from ibrobot_zenoh.commands.network import Network, on_network
from ibrobot_zenoh.ros2 import absolute, actions_of
from ibrobot_zenoh.ros_goals import Ended, SentGoal, Status
from ibrobot_zenoh.transport import ZenohTransport


@click.group()
def action() -> None:
    """List actions on the network, and send goals to them."""


@action.command(name="list")
@on_network
@click.option("-t", "--show-types", is_flag=True, help="Show the types, too.")
def list_(network: Network, show_types: bool) -> None:
    """List the actions that robots and ROS 2 nodes offer."""
    with network as transport:
        for name, type_name in actions_of(transport.shared_services()):
            echo(f"{name} [{type_name}]" if show_types else name)


@action.command()
@on_network
@click.argument("name", metavar="ACTION")
@click.argument("type_name", metavar="TYPE")
@click.argument("text", metavar="GOAL")
@click.option("-f", "--feedback", is_flag=True, help="Show the feedback, too.")
@click.option("--timeout", default=600.0, show_default=True, type=click.FloatRange(0.01), help="Longest wait [s].")
def send(network: Network, name: str, type_name: str, text: str, feedback: bool, timeout: float) -> None:
    """Send GOAL, as YAML, to ACTION, and wait for its result. Ctrl-C cancels the goal.

    E.g. `ibrobot action send /grip/gripper_cmd control_msgs/action/GripperCommand '{command: {position: 1}}'`.
    """
    document = parse_yaml(text, "GOAL")
    document.raise_problems()
    with wrong_input():
        kind = action_type(type_name)
    with network as transport:
        _check_type(transport, absolute(name), type_name)
        shown: Callable[[dict[str, Any]], object] = lambda each: echo(f"Feedback:\n{dump_yaml(each)}")  # noqa: E731
        goal = SentGoal(transport, absolute(name), kind, document.root or {}, shown if feedback else None)
        echo("Goal accepted")
        ended = _await(goal, timeout)
        echo(f"Result:\n{dump_yaml(ended.result)}\nGoal finished with status: {ended.status.name}")
    if ended.status is not Status.SUCCEEDED:
        raise TransportError(f"{name}: the goal ended as {ended.status.name}")


action.add_command(click.Command("send_goal", params=send.params, callback=send.callback, help=send.help, hidden=True))


def _check_type(transport: ZenohTransport, name: str, type_name: str) -> None:
    """Raise for an action of another type, which would look as if nobody served it."""
    known = dict(actions_of(transport.shared_services()))
    if known.get(name, type_name) != type_name:
        raise NotSupported(f"{name} is a {known[name]}, not a {type_name}")
    if name not in known:
        raise NotSupported(f"no action {name} on the network; there are {', '.join(known) or 'none'}")


def _await(goal: SentGoal, timeout_s: float) -> Ended:
    """The end of a goal; canceled by Ctrl-C."""
    try:
        return goal.result(timeout_s)
    except KeyboardInterrupt:
        echo("canceling", err=True)
        goal.cancel()
        return goal.result(timeout_s)
