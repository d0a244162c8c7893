"""Services of a run under types of ROS: their own, or std_srvs, if that can say their requests."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

import attrs

from ibrobot_core.api import NS_PER_S, IbrobotError
from ibrobot_core.app import RunView, Service
from ibrobot_ros2.services import plain

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
SET_MODE = "/set_mode"
"""The service that enters another control mode."""
CLOCK, CLOCK_TYPE = "/clock", "rosgraph_msgs/msg/Clock"
"""The topic of simulated time in ROS, and its type."""
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@attrs.frozen
class Offer:
    """A ROS service, and the call of the bus that answers it."""

    type: str
    service: str
    request: Mapping[str, Any]
    """Fields sent with every call."""
    field: str = ""
    """Field of the request filled from `SetBool.data`; empty without one."""
    urgent: bool = False


CHECK = Offer(TRIGGER, "/estop/check", {})
"""Service that tries out an emergency stop."""


def ros_type(service: Service[Any, Any]) -> tuple[str, str] | None:
    """The type of ROS that can say requests of a service, and the field that `data` is; None if there is none."""
    if service.ros_type:
        return (service.ros_type, "") if "/srv/" in service.ros_type else None
    fields = attrs.fields(service.request)
    required = [field for field in fields if field.default is attrs.NOTHING]
    if not required:
        return TRIGGER, ""
    if len(required) == 1 and required[0].type in (bool, "bool"):
        return SET_BOOL, required[0].name
    return None


class Offers:
    """The services that a run has, and each control mode as a service of its own.

    Args:
        session: the run.
        is_chosen: whether a service of the bus is offered.
        named: the full name of a service, from that on the bus.
    """

    def __init__(self, session: RunView, is_chosen: Callable[[str], bool], named: Callable[[str], str]) -> None:
        self._session = session
        self._is_chosen = is_chosen
        self._named = named

    def found(self) -> dict[str, Offer]:
        """The services that are served at present, by full name."""
        offers = {}
        for name, service in self._session.bus.services().items():
            if not self._is_chosen(name):
                continue
            if name == SET_MODE:
                for mode in self._session.config.control_modes:
                    offers[f"{name}/{mode}"] = Offer(TRIGGER, name, {"mode": mode})
            elif (kind := ros_type(service)) is not None:
                offers[name] = Offer(kind[0], name, {}, kind[1], service.urgent)
        named = {self._named(name): offer for name, offer in offers.items()}
        return {name: offer for name, offer in named.items() if _NAME.fullmatch(name)}

    def answer(self, offer: Offer, request: Mapping[str, Any]) -> dict[str, Any]:
        """The response to a request, for the fields that its type has.

        Of std_srvs: `success` and `message`, which is the run's own answer.
        """
        if offer.type not in (TRIGGER, SET_BOOL):
            return answered(self._session, offer.service, with_ns(request))
        full = {**offer.request, **({offer.field: request["data"]} if offer.field else {})}
        return answered(self._session, offer.service, full, lambda said: {"success": True, "message": _text(said)})


def answered(
    session: RunView, service: str, request: Mapping[str, Any], shaped: Callable[[Any], dict[str, Any]] = plain
) -> dict[str, Any]:
    """The answer of a service of the bus, as `shaped` makes it; its error as `success` and `message`."""
    try:
        return shaped(session.bus.call(service, request))
    except IbrobotError as error:
        return refused(error)
    except Exception:
        session.log.exception("%s failed", service)
        return {"success": False, "message": "the service failed; the robot's log has the cause"}


def refused(error: IbrobotError) -> dict[str, Any]:
    """An error as the fields of a response."""
    return {"success": False, "message": str(error)}


def time_of(stamp_ns: int) -> dict[str, int]:
    """A time or a duration [ns] as ROS's fields."""
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return {"sec": sec, "nanosec": nanosec}


def with_ns(value: Any) -> Any:
    """A plain request of ROS as runs take them: a time `x` is `x_ns` [ns]."""
    if isinstance(value, Mapping):
        stamped = {}
        for name, each in value.items():
            if isinstance(each, Mapping) and set(each) == {"sec", "nanosec"}:
                stamped[f"{name}_ns"] = each["sec"] * NS_PER_S + each["nanosec"]
            else:
                stamped[name] = with_ns(each)
        return stamped
    return [with_ns(each) for each in value] if isinstance(value, list) else value


def _text(answer: Any) -> str:
    if answer is None or isinstance(answer, str):
        return answer or ""
    return json.dumps(plain(answer))
