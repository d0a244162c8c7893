"""`ibrobot action list|send`: actions of robots and ROS 2 nodes on the network."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
from ibrobot_ros2.interfaces import action_type

from ibrobot_core.api import NotSupported, TransportError, option
from ibrobot_core.app import dump_yaml, echo, parse_yaml, wrong_input
from ibrobot_zenoh.commands.network import OnNetwork
from ibrobot_zenoh.ros2 import absolute, actions_of
from ibrobot_zenoh.ros_goals import Ended, SentGoal, Status
from ibrobot_zenoh.transport import ZenohTransport


@attrs.frozen(kw_only=True)
class ListActions(OnNetwork):
    """List the actions that robots and ROS 2 nodes offer."""

    show_types: bool = option(False, typed="-t", help="show the types, too")

    def __call__(self) -> None:
        with self.network() as transport:
            for name, type_name in actions_of(transport.shared_services()):
                echo(f"{name} [{type_name}]" if self.show_types else name)


@attrs.frozen(kw_only=True)
class SendGoal(OnNetwork):
    """Send GOAL, as YAML, to ACTION, and wait for its result. Ctrl-C cancels the goal.

    E.g. `ibrobot action send /grip/gripper_cmd control_msgs/action/GripperCommand '{command: {position: 1}}'`.
    """

    name: str = option(typed="ACTION", help="the action")
    type_name: str = option(typed="TYPE", help="its type, e.g. control_msgs/action/GripperCommand")
    text: str = option(typed="GOAL", help="the goal, as YAML")
    feedback: bool = option(False, typed="-f", help="show the feedback, too")
    timeout: float = option(600.0, ge=0.01, unit="s", help="longest wait")

    def __call__(self) -> None:
        document = parse_yaml(self.text, "GOAL")
        document.raise_problems()
        with wrong_input():
            kind = action_type(self.type_name)
        with self.network() as transport:
            _check_type(transport, absolute(self.name), self.type_name)
            shown: Callable[[dict[str, Any]], object] = lambda each: echo(f"Feedback:\n{dump_yaml(each)}")  # noqa: E731
            goal = SentGoal(transport, absolute(self.name), kind, document.root or {}, shown if self.feedback else None)
            echo("Goal accepted")
            ended = _await(goal, self.timeout)
            echo(f"Result:\n{dump_yaml(ended.result)}\nGoal finished with status: {ended.status.name}")
        if ended.status is not Status.SUCCEEDED:
            raise TransportError(f"{self.name}: the goal ended as {ended.status.name}")


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
