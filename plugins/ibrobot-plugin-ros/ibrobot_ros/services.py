"""Services of a run in ROS: those whose requests std_srvs can say."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from ibrobot_ros2.offers import Offer, Offers

from ibrobot_core.app import RunView
from ibrobot_ros.options import RosOptions
from ibrobot_ros.topics import ros_name
from ibrobot_ros.wire import Wire

_WORKERS, _URGENT_WORKERS = 16, 2


class Services:
    """Offers the services of the bus, and each control mode as a service of its own, and answers calls."""

    def __init__(self, options: RosOptions, session: RunView) -> None:
        self._session = session
        self._found = Offers(session, options.offers, lambda name: ros_name(name, options.namespace))
        self._offers: dict[str, Offer] = {}
        """What the present node offers."""
        self._pools: dict[bool, ThreadPoolExecutor] = {}
        """Threads for urgent services, and for others."""

    def open(self) -> None:
        """Begin to answer."""
        self._pools[False] = ThreadPoolExecutor(_WORKERS, "ros call")
        self._pools[True] = ThreadPoolExecutor(_URGENT_WORKERS, "ros stop")

    def close(self) -> None:
        """Wait for the answers under way."""
        for pool in self._pools.values():
            pool.shutdown(cancel_futures=True)

    def submit(self, work: Any, *arguments: Any, urgent: bool = False) -> None:
        """Do work that waits for the run, e.g. for a decision about a goal, in another thread."""
        self._pools[urgent].submit(self._contained, work, *arguments)

    def declare(self, wire: Wire) -> None:
        """Tell a new node which services there are."""
        self._offers.clear()
        self.refresh(wire)

    def refresh(self, wire: Wire) -> None:
        """Tell the node which services are new."""
        for name, offer in self._found.found().items():
            if name not in self._offers:
                self._offers[name] = offer
                wire.send({"op": "service", "name": name, "type": offer.type, "urgent": offer.urgent})

    def take_call(self, wire: Wire, head: Mapping[str, Any]) -> None:
        """Answer a call, in another thread."""
        offer = self._offers[head["service"]]
        self.submit(self._answer, wire, offer, head, urgent=offer.urgent)

    def _answer(self, wire: Wire, offer: Offer, head: Mapping[str, Any]) -> None:
        wire.send({"op": "answer", "call": head["call"], **self._found.answer(offer, head["request"])})

    def _contained(self, work: Any, *arguments: Any) -> None:
        try:
            work(*arguments)
        except Exception:
            self._session.log.exception("ros: a request failed")
