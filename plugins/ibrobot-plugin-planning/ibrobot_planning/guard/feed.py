"""Tells the guard in the control process what the world of the run has become."""

from __future__ import annotations

from typing import override

from ibrobot_core.app import CONTROL, RunView, SessionWorker
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.meshes import Meshes
from ibrobot_planning.guard.notice import say, say_whether_it_acted
from ibrobot_planning.world.objects import World, observed_world

_MOST = 16
"""Objects of one message: control reads it within a tick."""


class GuardFeed(SessionWorker):
    """Compares the world with what the guard knows at each state of control, and sends what has changed."""

    urgent = True

    def __init__(self, session: RunView) -> None:
        super().__init__(session, "guard", "tells the guard of changes of the world", (CONTROL, "world"))
        self._sent, self._stale = World(), ""
        self._meshes = Meshes()

    @override
    def setup(self) -> None:
        say(self.session)
        self._states = self.session.watch_states()
        self._update()

    @override
    def work(self, timeout_s: float) -> None:
        if self._states.get(timeout_s) is not None:
            self._update()

    @override
    def teardown(self) -> None:
        say_whether_it_acted(self.session)

    def _update(self) -> None:
        observed = observed_world(self.session.bus)
        stale = observed.refusal  # also while the first message of a cloud is awaited: nobody knows what is there
        world = self._meshes.simple(observed.world)
        if world == self._sent and stale == self._stale:
            return
        for part in WorldChange.between(self._sent, world, stale).parts(_MOST):
            self.session.change_world(part.message())
        self._sent, self._stale = world, stale
