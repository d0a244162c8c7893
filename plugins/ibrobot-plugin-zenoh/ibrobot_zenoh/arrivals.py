"""Requests that a stalled network delivers late: what was sent before a stop moves nothing after its reset."""

from __future__ import annotations

from ibrobot_core.api import NS_PER_S, HardwareError
from ibrobot_core.app import ControlState, RunView


class Arrivals:
    """Refuses requests that were sent before an emergency stop or a fault, or before its reset, which is over.

    Services that are `urgent`, e.g. emergency stops, and those that only read are always answered.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self._stops = 0
        """Number of emergency stops that the times know of."""
        self._stopped = False
        """Whether the robot waits for a reset, as far as the times know."""
        self._seen_ns: int | None = None
        """When the newest state came, by the run's clock [ns]."""
        self._began_ns: int | None = None
        """When the last state before the last stop came [ns]; None: not stopped yet."""
        self._until_ns: int | None = None
        """When the last state before the last reset came [ns]; None: not stopped yet."""
        session.on_state.append(self._take_state)

    # All times are those of states that came before the answer of the stop or reset. So what its sender sends next is
    # not too old, and what was sent up to one state before a stop counts as sent after it.

    def _take_state(self, state: ControlState) -> None:
        now_ns, stops, stopped = self._session.clock.now_ns(), self._session.stops, bool(self._session.stopped_by)
        begins = stops > self._stops or (stopped and not self._stopped)
        if begins:
            self._began_ns = self._until_ns = self._seen_ns
        if stopped:
            self._until_ns = now_ns
        self._stops, self._stopped = stops, stopped or begins
        self._seen_ns = now_ns

    def _bound(self) -> int | None:
        """What was sent before this time is refused [ns]."""
        stopped = bool(self._session.stopped_by)
        if self._session.stops > self._stops or (stopped and not self._stopped):
            return self._seen_ns  # no state has come since
        return self._began_ns if stopped else self._until_ns

    def check(self, service: str, sent_ns: int) -> None:
        """Refuse a request that is too old.

        Args:
            service: name of the bus's service; empty for the goal of an executor.
            sent_ns: when it was sent, by the sender's time of day [ns]; 0 stands for now.

        Raises:
            HardwareError: if it was sent before the robot was last stopped, or reset.
        """
        declared = self._session.bus.services().get(service)
        if not sent_ns or (declared is not None and (declared.urgent or declared.reads)):
            return
        now_ns, age_ns = self._session.clock.now_ns(), self._session.clock.age_ns(sent_ns)
        bound_ns = self._bound()
        if bound_ns is not None and (early_ns := bound_ns - (now_ns - age_ns)) > 0:
            raise HardwareError(
                f"{service or 'the goal'}: refused, it was sent before the robot was last stopped or reset, "
                f"{early_ns / NS_PER_S:.3f} s too early; send it again. If it is refused again, set the clock of its "
                "sender, which is behind the robot's"
            )
