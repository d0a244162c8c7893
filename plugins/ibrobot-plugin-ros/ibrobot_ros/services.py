"""Services of a run in ROS: those whose requests std_srvs can say."""

from __future__ import annotations

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import attrs
from ibrobot_ros2.services import plain

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import SET_MODE, RunView, Service
from ibrobot_ros.options import NAME, RosOptions
from ibrobot_ros.topics import ros_name
from ibrobot_ros.wire import Wire

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
_WORKERS, _URGENT_WORKERS = 16, 2


@attrs.frozen
class _Offer:
    """A ROS service, and the call of the bus that answers it."""

    type: str
    service: str
    request: Mapping[str, Any]
    """What is sent with every call."""
    field: str = ""
    """The key of the request that SetBool's `data` is."""
    urgent: bool = False


def ros_type(service: Service[Any, Any]) -> tuple[str, str] | None:
    """The type of std_srvs that can say requests of a service, and the field that `data` is; None if there is none."""
    fields = attrs.fields(service.request)
    required = [field for field in fields if field.default is attrs.NOTHING]
    if not required:
        return TRIGGER, ""
    if len(required) == 1 and required[0].type in (bool, "bool"):
        return SET_BOOL, required[0].name
    return None


class Services:
    """Offers the services of the bus, and each control mode as a service of its own, and answers calls."""

    def __init__(self, options: RosOptions, session: RunView) -> None:
        self._options = options
        self._session = session
        self._offers: dict[str, _Offer] = {}
        self._offered: set[str] = set()
        self._calls: ThreadPoolExecutor | None = None
        self._urgent: ThreadPoolExecutor | None = None

    def open(self) -> None:
        """Begin to answer."""
        self._calls = ThreadPoolExecutor(_WORKERS, "ros call")
        self._urgent = ThreadPoolExecutor(_URGENT_WORKERS, "ros stop")

    def close(self) -> None:
        """Wait for the answers under way."""
        for pool in (self._calls, self._urgent):
            if pool is not None:
                pool.shutdown(cancel_futures=True)

    def submit(self, work: Any, *arguments: Any) -> None:
        """Do other work that waits for the run, e.g. for a decision about a goal."""
        assert self._calls is not None
        self._calls.submit(self._contained, work, *arguments)

    def declare(self, wire: Wire) -> None:
        """Tell a new node which services there are."""
        self._offered.clear()
        self.refresh(wire)

    def refresh(self, wire: Wire) -> None:
        """Tell the node which services are new."""
        for name, offer in self._found().items():
            if name not in self._offered:
                self._offered.add(name)
                self._offers[name] = offer
                wire.send({"op": "service", "name": name, "type": offer.type, "urgent": offer.urgent})

    def take_call(self, wire: Wire, head: Mapping[str, Any]) -> None:
        """Answer a call, in a thread of its own."""
        offer = self._offers[head["service"]]
        pool = self._urgent if offer.urgent else self._calls
        assert pool is not None
        pool.submit(self._contained, self._answer, wire, offer, head)

    def _found(self) -> dict[str, _Offer]:
        found = {}
        for name, service in self._session.bus.services().items():
            if self._options.services != "all" and name not in self._options.services:
                continue
            if name == SET_MODE.name:
                for mode in self._session.config.control_modes:
                    found[f"{name}/{mode}"] = _Offer(TRIGGER, name, {"mode": mode})
            elif (kind := ros_type(service)) is not None:
                found[name] = _Offer(kind[0], name, {}, kind[1], service.urgent)
        named = {ros_name(name, self._options.namespace): offer for name, offer in found.items()}
        return {name: offer for name, offer in named.items() if NAME.fullmatch(name)}

    def _answer(self, wire: Wire, offer: _Offer, head: Mapping[str, Any]) -> None:
        request = {**offer.request, **({offer.field: head["request"]["data"]} if offer.field else {})}
        try:
            answer = self._session.bus.call(offer.service, request)
            found = {"success": True, "message": _text(answer)}
        except IbrobotError as error:
            found = {"success": False, "message": str(error)}
        except Exception:
            self._session.log.exception("ros: %s failed", offer.service)
            found = {"success": False, "message": "the service failed; the robot's log has the cause"}
        wire.send({"op": "answer", "call": head["call"], **found})

    def _contained(self, work: Any, *arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception:
            self._session.log.exception("ros: a request failed")


def _text(answer: Any) -> str:
    if answer is None or isinstance(answer, str):
        return answer or ""
    return json.dumps(plain(answer))
