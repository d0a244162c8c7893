"""Services of a run for other machines."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any, override

import attrs
from ibrobot_ros2.services import (
    DETAILS,
    SERVICES,
    Answer,
    Call,
    decode_answer,
    decode_call,
    encode_answer,
    encode_call,
    endpoint,
)
from ibrobot_ros2.workers import StopWay
from ibrobot_terminal.describe import described, type_name

from ibrobot_core.api import IbrobotError, NotSupported, Payload, TransportError, did_you_mean
from ibrobot_core.app import Component, RunView
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.network import Link, transport_of
from ibrobot_zenoh.options import Share

_STOP, _CHECK = "/estop", "/estop/check"
_MOST_BYTES = 1 << 20
"""Largest request to a service [bytes]."""
_URGENT_BYTES = 1000
"""Largest request to an urgent service [bytes]."""
_CHECK_S = 10.0
"""Longest wait for the answer to a stop that is only tried [s]."""


class SharedServices(Component):
    """Answers calls of the bus's services from other machines.

    A name that ends with / means all services whose names begin with it. `/rosapi/services` lists the services,
    and `/rosapi/service_request_details` describes one.
    """

    def __init__(self, session: RunView, link: Link, share: Share, arrivals: Arrivals) -> None:
        super().__init__("share:services", f"{', '.join(share.services)} for other machines", (link.name,))
        self._session = session
        self._link = link
        self._share = share
        self._arrivals = arrivals
        self._way = StopWay(session, "services for other machines")
        self._ends = ExitStack()

    def _offers(self, name: str) -> bool:
        return self._share.offers(_STOP if name == _CHECK else name)

    @override
    def start(self) -> None:
        transport = transport_of(self._link)
        name = endpoint(transport.namespace)
        served = transport.serve_with_urgent(name, self._answer, self._is_urgent, _MOST_BYTES, self._way)
        self._ends.callback(served.end)
        self._way.open()
        self._ends.callback(self._way.close)
        if self._offers(_STOP):
            answer = decode_answer(served.ask(encode_call(Call(_CHECK)), _CHECK_S))
            if not answer.result:
                raise TransportError(f"an emergency stop by {name} would fail: {answer.values}")

    @override
    def stop(self) -> None:
        self._ends.close()

    def _is_urgent(self, payload: Payload) -> bool:
        """Whether a request is for an urgent service. It delays all other requests, so only short ones are read."""
        if len(payload) > _URGENT_BYTES:
            return False
        try:
            service = self._session.bus.services().get(decode_call(payload).service)
        except IbrobotError:
            return False
        return service is not None and service.urgent

    def _answer(self, payload: Payload, sender: str | None, sent_ns: int) -> bytes:
        call = None
        try:
            call = decode_call(payload)
            if call.service == SERVICES:
                return encode_answer(Answer(self._shared()))
            name = str(call.request) if call.service == DETAILS else call.service
            if not self._offers(name):
                raise NotSupported(
                    f"{name} is not shared{did_you_mean(name, self._shared(), 'shared')};"
                    " transport.share.services of the robot lists what is"
                )
            if call.service == DETAILS:
                return encode_answer(Answer(self._details(name)))
            self._arrivals.check(name, sent_ns)
            return encode_answer(Answer(self._session.bus.call(name, call.request)))
        except IbrobotError as error:
            return encode_answer(Answer(str(error), result=False))
        except Exception as error:
            if call is None or call.service == _STOP:
                self._way.lose(error)
            self._session.log.exception("a service failed")
            return encode_answer(Answer("the service failed; the robot's log has the cause", result=False))

    def _details(self, name: str) -> dict[str, Any]:
        """The declaration of a service, as JSON values."""
        service = self._session.bus.services().get(name)
        if service is None:
            raise NotSupported(f"nothing serves {name} at present; served are {', '.join(self._shared())}")
        keys = {"request": service.request, "answer_keys": service.answer}
        tables = {
            name: [attrs.asdict(key) for key in described(kind)] if isinstance(kind, type) and attrs.has(kind) else []
            for name, kind in keys.items()
        }
        return {"help": service.help, "alone": service.alone, "answer": type_name(service.answer), **tables}

    def _shared(self) -> list[str]:
        """The shared services that are served at present."""
        return [name for name in self._session.bus.services() if self._offers(name)]
