"""`ibrobot service list|show|call`: services that a robot shares over the network."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import attrs
from ibrobot_ros2.interfaces import service_type
from ibrobot_ros2.services import DETAILS, SERVICES, Call, decode_answer, encode_call, endpoint

from ibrobot_core.api import NotSupported, TransportError, option
from ibrobot_core.app import RequestError, dump_yaml, echo, parse_yaml
from ibrobot_zenoh.commands.network import OnNetwork
from ibrobot_zenoh.ros2 import HIDDEN, absolute
from ibrobot_zenoh.transport import ZenohTransport

_TYPE = re.compile(r"\w+/srv/\w+")


@attrs.frozen(kw_only=True)
class OnRobot(OnNetwork):
    """The options that select a robot."""

    namespace: str = option("", typed="--namespace NAME", help="the robot's namespace, e.g. arm1")


def _ask(transport: ZenohTransport, namespace: str, call: Call, timeout_s: float) -> Any:
    answer = decode_answer(transport.request(endpoint(namespace), encode_call(call), timeout_s))
    if not answer.result:
        raise NotSupported(str(answer.values))
    return answer.values


@attrs.frozen(kw_only=True)
class ListServices(OnRobot):
    """List the services of the robot, and of ROS 2 nodes."""

    typed: bool = option(False, typed="-t --show-types", help="show types: those that ROS 2 nodes can call have one")

    def __call__(self) -> None:
        with self.network() as transport:
            types = {each.name: each.type for each in transport.shared_services() if each.servers}
            try:
                own = _ask(transport, self.namespace, Call(SERVICES), 5.0)
            except TransportError:
                if not types:
                    raise
                own = []  # the network has ROS 2 nodes alone
        shown = {name for name in types if HIDDEN not in name}  # as in ros2: not those of actions
        for name in sorted({*own, *shown}):
            echo(f"{name} [{types[name]}]" if self.typed and name in types else name)


@attrs.frozen(kw_only=True)
class ShowService(OnRobot):
    """Show what SERVICE does, its request and its answer."""

    name: str = option(typed="SERVICE", help="the service")

    def __call__(self) -> None:
        with self.network() as transport:
            details = _ask(transport, self.namespace, Call(DETAILS, self.name), 5.0)
        echo(f"{self.name}: {details['help']}")
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


@attrs.frozen(kw_only=True)
class CallService(OnRobot):
    """Call SERVICE with REQUEST, as YAML, and print the answer.

    E.g. `ibrobot service call /planning/go_to home` or `… /world/remove '{name: can}'`. With TYPE, it calls a service
    of a ROS 2 node, or of a robot under that type, e.g. `… /estop std_srvs/srv/Trigger`.
    """

    name: str = option(typed="SERVICE", help="the service")
    words: tuple[str, ...] = option((), typed="[TYPE] [REQUEST]", help="a type of ROS 2, and the request")
    timeout: float = option(60.0, ge=0.01, unit="s", help="longest wait")
    text: bool = option(False, help="send REQUEST as text, unparsed")

    def __call__(self) -> None:
        is_ros = bool(self.words) and _TYPE.fullmatch(self.words[0]) is not None
        if len(self.words) > 1 + is_ros:
            raise RequestError(f"got {len(self.words)} words after {self.name}; quote REQUEST")
        request = self.words[is_ros] if len(self.words) > is_ros else "null"
        value: Any = request
        if not self.text:
            document = parse_yaml(request, "REQUEST")
            document.raise_problems()
            value = document.root
        with self.network() as transport:
            if is_ros:
                full = absolute(self.name, self.namespace)
                answer: Any = transport.call_ros(full, service_type(self.words[0]), value or {}, self.timeout)
            else:
                answer = _ask(transport, self.namespace, Call(self.name, value), self.timeout)
        if answer is not None:
            echo(dump_yaml(answer).removesuffix("\n") if isinstance(answer, dict | list) else str(answer))
