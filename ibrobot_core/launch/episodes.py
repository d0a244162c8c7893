"""The life cycle of episodes: numbering, counting, and hooks for plugins."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from ibrobot_core.interfaces.run import RecordedRun


class Episodes:
    """Begins, ends and counts episodes. Not thread-safe."""

    def __init__(self, session: RecordedRun) -> None:
        self._session = session
        self.number = 0
        """Number of the present episode, from 1; 0 before the first."""
        self.running = False
        self.prompt = session.request.prompt
        """Prompt of the next episode."""
        self.begun_ns = 0
        """Start of the present episode [ns]."""
        self.faults: tuple[str, ...] = ()
        """The faults and emergency stops that have stopped the robot since the present or last episode began."""

    def begin(self) -> None:
        """Begin the next episode."""
        session = self._session
        self.number += 1
        self.running = True
        self.begun_ns = session.clock.now_ns()
        self.faults = ()
        session.emit("ibrobot_episode_started", episode=self.number, mode=session.mode)

    def judged(self, outcome: str) -> str:
        """Final outcome of the present episode, judged as `outcome`; never success after a fault or stop."""
        return "failure" if outcome == "success" and self.faults else outcome

    def end(self, outcome: str) -> None:
        """End the present episode, if any, with outcome `success`, `failure`, `discarded` or `unknown`."""
        if not self.running:
            return
        session = self._session
        self.running = False
        outcome = self.judged(outcome)
        if self.faults and outcome != "discarded":
            session.outcome.disturbed += 1
            session.log.warning("episode %d is disturbed by: %s", self.number, "; ".join(self.faults))
        if outcome == "discarded":
            session.log.info("episode %d: discarded", self.number)
        elif outcome == "unknown":
            session.outcome.unjudged += 1
        else:
            session.outcome.episodes += 1
            session.outcome.successes += outcome == "success"
            session.log.info("episode %d: %s", self.number, outcome)
        session.emit("ibrobot_episode_ended", episode=self.number, outcome=outcome)


@runtime_checkable
class EpisodeRecorder(Protocol):
    """A component that records a run's episodes; the plan lets its `episodes` begin and end them."""

    @property
    def episodes(self) -> Episodes:
        """Begins, ends and counts the episodes."""
