"""The robot YAML of a run as parameters of its node, for ROS 2 nodes; the control mode is one that can be set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from enum import IntEnum
from typing import Any, override

from ibrobot_ros2.interfaces import service_type
from ibrobot_ros2.offers import SET_MODE

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Component, RunView, dump_yaml
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.network import Link, Reply, transport_of

MODE = "mode"
"""The parameter that is the control mode."""


class ParameterType(IntEnum):
    """Type of a parameter, as in rcl_interfaces/msg/ParameterType."""

    NOT_SET = 0
    BOOL = 1
    INTEGER = 2
    DOUBLE = 3
    STRING = 4
    BYTE_ARRAY = 5
    BOOL_ARRAY = 6
    INTEGER_ARRAY = 7
    DOUBLE_ARRAY = 8
    STRING_ARRAY = 9

    @property
    def field(self) -> str:
        """The field of a ParameterValue that has the value."""
        return f"{self.name.lower()}_value"


def to_parameter(value: Any) -> dict[str, Any]:
    """A plain value as a ParameterValue; lists of several types become text."""
    kind = _type_of(value)
    if kind is ParameterType.NOT_SET:
        return {"type": kind}
    if kind is ParameterType.STRING and not isinstance(value, str):
        value = dump_yaml(value).strip()
    if kind is ParameterType.DOUBLE_ARRAY:
        value = [float(each) for each in value]
    return {"type": kind, kind.field: value}


def from_parameter(parameter: Mapping[str, Any]) -> Any:
    """The plain value of a ParameterValue; None if it is not set."""
    kind = ParameterType(parameter["type"])
    return None if kind is ParameterType.NOT_SET else parameter[kind.field]


def _type_of(value: Any) -> ParameterType:
    scalars = {bool: ParameterType.BOOL, int: ParameterType.INTEGER, float: ParameterType.DOUBLE}
    if value is None:
        return ParameterType.NOT_SET
    if isinstance(value, list | tuple) and value:
        kinds = {type(each) for each in value}
        if kinds == {str}:
            return ParameterType.STRING_ARRAY
        if kinds == {int, float}:
            return ParameterType.DOUBLE_ARRAY
        if len(kinds) == 1 and (kind := scalars.get(kinds.pop())) is not None:
            return ParameterType[f"{kind.name}_ARRAY"]
    return scalars.get(type(value), ParameterType.STRING)


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The values of a document by dotted names; lists of values are values."""
    if isinstance(value, Mapping) and value:
        for key, each in value.items():
            yield from flat(each, f"{name}.{key}".lstrip("."))
    elif isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value):
        for i, each in enumerate(value):
            yield from flat(each, f"{name}.{i}")
    else:
        yield name, value


class RosParameters(Component):
    """Answers `ros2 param`.

    Args:
        session: the run.
        link: its transport.
        is_shared: whether others may call a service of the bus: setting the mode needs `/set_mode`.
        arrivals: refuses requests to set the mode that come too late.
    """

    def __init__(
        self, session: RunView, link: Link, is_shared: Callable[[str], bool], arrivals: Arrivals
    ) -> None:  # fmt: skip
        super().__init__("share:parameters", "this file as parameters", (link.name,))
        self._session = session
        self._link = link
        self._is_shared = is_shared
        self._arrivals = arrivals
        self._ends = ExitStack()

    @override
    def start(self) -> None:
        transport = transport_of(self._link)
        self._values = dict(flat(self._session.config.document))
        for name, handler in (("List", self._list), ("Get", self._get), ("Set", self._set)):
            kind = service_type(f"rcl_interfaces/srv/{name}Parameters")
            full = f"{transport.node_name}/{name.lower()}_parameters"
            self._ends.callback(transport.serve_ros(full, kind, handler))

    @override
    def stop(self) -> None:
        self._ends.close()

    def _list(self, request: dict[str, Any], reply: Reply) -> None:
        prefixes, depth = request["prefixes"], request["depth"]
        names = [
            name
            for name in (MODE, *self._values)
            if (not prefixes or any(name == each or name.startswith(f"{each}.") for each in prefixes))
            and (not depth or name.count(".") < depth)
        ]
        reply({"result": {"names": names, "prefixes": sorted({n.rpartition(".")[0] for n in names} - {""})}})

    def _get(self, request: dict[str, Any], reply: Reply) -> None:
        now = {**self._values, MODE: self._session.mode}
        reply({"values": [to_parameter(now.get(name)) for name in request["names"]]})

    def _set(self, request: dict[str, Any], reply: Reply) -> None:
        sent_ns, given = reply.sent_ns, request["parameters"]
        reply({"results": [self._set_one(each["name"], each["value"], sent_ns) for each in given]})

    def _set_one(self, name: str, value: Mapping[str, Any], sent_ns: int) -> dict[str, Any]:
        if name == MODE and self._is_shared(SET_MODE):
            try:
                self._arrivals.check(SET_MODE, sent_ns)
                self._session.bus.call(SET_MODE, {"mode": from_parameter(value)})
            except (IbrobotError, ValueError) as error:
                return {"successful": False, "reason": str(error)}
            return {"successful": True}
        if name == MODE:
            reason = f"{SET_MODE} is not shared; transport.share.services of the robot lists what is"
        elif name in self._values:
            reason = f"is read when a run starts: `ibrobot launch … --set {name}=…`"
        else:
            reason = "there is no such parameter"
        return {"successful": False, "reason": reason}
