"""A desktop window that shows the simulated scene; the mouse rotates and zooms the view."""

from __future__ import annotations

import threading
import warnings
from typing import Any, override

from ibrobot_core.api import Context, IbrobotError, Options, Viewer
from ibrobot_core.app import Subscription
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.state import PHYSICS_TOPIC, DrawnWorld, newest

_QUEUE = 100
_CLOSING_S = 5.0


class MujocoViewer(Viewer):
    """Shows the physics state on the bus. Actions in the window do not affect the simulation."""

    def __init__(self, options: Options, ctx: Context) -> None:
        self._ctx = ctx
        self._window: Any = None
        self._states: Subscription | None = None

    @override
    def open(self) -> None:
        simulation, bus = self._ctx.simulation, self._ctx.bus
        if not isinstance(simulation, MujocoOptions) or bus is None:
            raise IbrobotError("viewer type mujoco needs a running simulation: {type: mujoco}")
        # Import late, because these modules open the window system, which only this viewer needs.
        import glfw
        from mujoco import viewer

        with warnings.catch_warnings(record=True) as reasons:
            warnings.simplefilter("always")
            # Check first, because MuJoCo's viewer would wait for its window forever.
            if not glfw.init():
                why = "; ".join(str(reason.message) for reason in reasons)
                raise IbrobotError(
                    f"no display for the viewer's window, see DISPLAY and WAYLAND_DISPLAY: {why}; run without "
                    "--window, or with --web, which shows the robot in a browser"
                )
        self._drawn = drawn = DrawnWorld.of(simulation, self._ctx.robot)
        others = set(threading.enumerate())
        self._window = viewer.launch_passive(drawn.model, drawn.data, show_left_ui=False, show_right_ui=False)
        self._threads = [t for t in threading.enumerate() if t not in others and "_launch_internal" in t.name]
        with self._window.lock():
            self._window.cam.lookat[:] = 0.16, 0.05, 0.08
            self._window.cam.distance, self._window.cam.azimuth, self._window.cam.elevation = 0.9, 150, -25
        self._states = bus.subscribe(PHYSICS_TOPIC, _QUEUE)

    @override
    def update(self) -> bool:
        if self._window is None or self._states is None or not self._window.is_running():
            return False
        state = newest(self._states)
        if state is not None:
            with self._window.lock():
                self._drawn.follow(state)
            self._window.sync()
        return True

    @override
    def close(self) -> None:
        if self._states is not None:
            self._states.close()
            self._states = None
        if self._window is not None:
            self._window.close()
            # A process that exits while the window is still closing crashes.
            for thread in self._threads:
                thread.join(_CLOSING_S)
            self._window = None

    @override
    def where(self) -> str:
        return "a window on this desktop"
