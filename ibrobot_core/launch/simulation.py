"""Simulation: sets up episodes one after another, and evaluates them by the scene's success predicate."""

from __future__ import annotations

from typing import override

from ibrobot_core.component import SessionWorker
from ibrobot_core.control.core import EMERGENCY_STOP
from ibrobot_core.launch.session import Session
from ibrobot_core.units import NS_PER_S, ns


class SimulatedEpisodes(SessionWorker):
    """Episodes of a policy in a simulated scene; seeds count up from the seed of the run."""

    session: Session

    def __init__(self, session: Session, needs: tuple[str, ...]) -> None:
        wanted = session.request.episodes
        summary = f"{'endless' if wanted is None else wanted}, from seed {session.request.seed}"
        super().__init__(session, "episodes", summary, needs)
        self._wanted = wanted
        self._longest_ns = ns(session.config.contract.max_duration_s)
        self._begun_ns: int | None = None
        self._stopped = 0
        """Number of episodes that an emergency stop ended; others take their places."""

    @override
    def work(self, timeout_s: float) -> None:
        session = self.session
        # A mode switch holds this lock while it waits for this thread to end.
        if not session.finished.is_set() and session.changing.acquire(blocking=False):
            try:
                self._judge(session)
            finally:
                session.changing.release()
        if timeout_s > 0:
            self.pause(min(timeout_s, session.config.control.rate_hz**-1))

    def _judge(self, session: Session) -> None:
        state = session.state
        if self._begun_ns is None:
            if not (session.held or (state is not None and state.estop)):
                self._begin_episode()
        elif EMERGENCY_STOP in session.episodes.faults:
            self._stopped += 1
            self._end_episode("failure")
        elif state is not None and state.generation == session.generation and state.success:
            self._end_episode("success")
        elif (age_ns := session.clock.now_ns() - self._begun_ns) > self._longest_ns:
            session.log.info("episode %d: no success within %.1f s", session.episodes.number, age_ns / NS_PER_S)
            self._end_episode("failure")

    def _begin_episode(self) -> None:
        session = self.session
        seed = session.request.seed + session.episodes.number
        if not session.reset_episode(seed):
            return  # an emergency stop is latched
        self._begun_ns = session.clock.now_ns()
        session.episodes.begin()
        session.command_source.begin(seed)

    def _end_episode(self, outcome: str) -> None:
        session = self.session
        session.end_source()
        self._begun_ns = None
        session.episodes.end(outcome)
        if self._wanted is not None and session.episodes.number - self._stopped >= self._wanted:
            session.finish()
