"""Services of a run in ROS: those whose requests std_srvs can say."""

from __future__ import annotations

import queue
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from ibrobot_ros2.offers import CHECK, Offer, Offers
from ibrobot_ros2.workers import StopWay, Workers

from ibrobot_core.app import Channel, ComponentFailed, RunView
from ibrobot_ros.options import RosOptions
from ibrobot_ros.topics import ros_name

_WORKERS, _URGENT_WORKERS = 16, 2
_MOST = 1000
"""Most calls that wait."""
_CHECK_S = 10.0
"""Longest wait for the answer to a stop that is only tried out [s]."""


class Services:
    """Offers the services of the bus, and each control mode as a service of its own, and answers calls."""

    def __init__(self, options: RosOptions, session: RunView) -> None:
        self._session = session
        self._found = Offers(session, options.offers, lambda name: ros_name(name, options.namespace))
        self._offers: dict[str, Offer] = {}
        """What the present node offers."""
        self._way = StopWay(session, "services for ROS 2 nodes")
        self._workers: dict[bool, Workers[Callable[[], object]]] = {}
        """Threads for urgent services, and for others."""

    def open(self) -> None:
        """Begin to answer, and try out an emergency stop, once.

        Raises:
            IbrobotError: if it would fail.
        """
        self._workers[False] = Workers(lambda work: work(), "ros call", _WORKERS, _MOST)
        self._workers[True] = Workers(lambda work: work(), "ros stop", _URGENT_WORKERS, way=self._way)
        self._way.open()
        answers: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self.submit(lambda: answers.put(self._found.answer(CHECK, {})), urgent=True)
        try:
            answer = answers.get(timeout=_CHECK_S)
        except queue.Empty:
            answer = {"success": False, "message": f"no answer within {_CHECK_S:g} s"}
        if self._session.bus.serves("/estop") and not answer["success"]:
            raise ComponentFailed(f"an emergency stop from ROS would fail: {answer['message']}")

    def close(self) -> None:
        """Wait for the answers under way."""
        self._way.close()
        for workers in self._workers.values():
            workers.end()

    def submit(self, work: Callable[[], object], *, urgent: bool = False) -> bool:
        """Do work that waits for the run, e.g. for a decision about a goal, in another thread.

        Returns:
            Whether it will be done; not if too many wait, or no thread for it can start now.
        """
        return self._workers[urgent].put(work) is None

    def declare(self, channel: Channel) -> None:
        """Tell a new node which services there are."""
        self._offers.clear()
        self.refresh(channel)

    def refresh(self, channel: Channel) -> None:
        """Tell the node which services are new."""
        for name, offer in self._found.found().items():
            if name not in self._offers:
                self._offers[name] = offer
                channel.send({"op": "service", "name": name, "type": offer.type, "urgent": offer.urgent})

    def take_call(self, channel: Channel, head: Mapping[str, Any]) -> None:
        """Answer a call, in another thread."""
        offer = self._offers[head["service"]]
        if not self.submit(partial(self._answer, channel, offer, head), urgent=offer.urgent):
            busy = {"success": False, "message": "the robot has no thread for this call: too many calls wait"}
            channel.send({"op": "answer", "call": head["call"], **busy})

    def _answer(self, channel: Channel, offer: Offer, head: Mapping[str, Any]) -> None:
        channel.send({"op": "answer", "call": head["call"], **self._found.answer(offer, head["request"])})
