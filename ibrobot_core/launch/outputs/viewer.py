"""Viewer: shows the robot in a window or browser; runs in the host."""

from __future__ import annotations

import time
from typing import override

from ibrobot_core.component import SessionWorker
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.interfaces import Viewer
from ibrobot_core.interfaces.run import RunView

_RATE_HZ = 30.0


class ViewerWorker(SessionWorker):
    """Updates a viewer 30 times a second; closing the window ends the run."""

    sends_stops = True
    urgent = True

    def __init__(self, session: RunView, component: ComponentConfig, needs: tuple[str, ...]) -> None:
        super().__init__(session, "viewer", component.type, needs)
        self._component = component

    @override
    def setup(self) -> None:
        self._viewer: Viewer = self.session.make("viewer", self._component, "viewer", session=self.session)
        self.on_end.callback(self._viewer.close)
        self._viewer.open()
        if where := self._viewer.where():
            self.session.log.info("viewer: %s", where)

    @override
    def work(self, timeout_s: float) -> None:
        begun = time.monotonic()
        if not self._viewer.update():
            self.session.finish()
        if timeout_s > 0:
            self.pause(max(0.0, 1.0 / _RATE_HZ - (time.monotonic() - begun)))
