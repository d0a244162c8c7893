"""The viewer: conformance against a window made up, its errors, and a real window where there is a display."""

from __future__ import annotations

import contextlib
import os
from types import SimpleNamespace
from typing import Any, ClassVar, override

import glfw
import mujoco
import numpy as np
import pytest
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.so101 import so101
from ibrobot_mujoco.state import PHYSICS_TOPIC, physics_size
from ibrobot_mujoco.viewer import MujocoViewer
from ibrobot_testing import ViewerSuite, host_context
from ibrobot_testing.suite import Suite
from mujoco import viewer as mujoco_viewer

from ibrobot_core.api import Context, Float64MultiArray, IbrobotError, Message, Options, Viewer

ROBOT = so101()
OPTIONS = MujocoOptions()
WORLD, SCENE = build_world(OPTIONS, ROBOT, visual=False)
MODEL = WORLD.model
FACTORS = SCENE.begin(WORLD, np.random.default_rng(0))


def state(i: int) -> Float64MultiArray:
    qpos = MODEL.qpos0 + 1e-3 * i * (np.arange(MODEL.nq) < 6)
    return Float64MultiArray(np.concatenate([[0.0, 0.0], qpos, FACTORS]))


class Window:
    """Stands for MuJoCo's window: shows what it was last given."""

    latest: ClassVar[Window]

    def __init__(self, model: mujoco.MjModel, drawn: mujoco.MjData, **_: Any) -> None:
        self.cam = SimpleNamespace(lookat=np.zeros(3), distance=0.0, azimuth=0.0, elevation=0.0)
        self._drawn, self._open, self.shown = drawn, True, np.empty(0)
        Window.latest = self

    def is_running(self) -> bool:
        return self._open

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.shown = self._drawn.qpos.copy()

    def close(self) -> None:
        self._open = False


class _Subject(Suite[Viewer]):
    @override
    def context(self) -> Context:
        return host_context("window", robot=ROBOT, simulation=OPTIONS)

    @override
    def make(self, ctx: Context) -> MujocoViewer:
        return MujocoViewer(Options(), ctx)


class TestConformance(_Subject, ViewerSuite):
    topic = PHYSICS_TOPIC

    @pytest.fixture(autouse=True)
    def made_up_window(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(glfw, "init", lambda: True)
        monkeypatch.setattr(mujoco_viewer, "launch_passive", Window)

    @override
    def message(self, ctx: Context, i: int) -> Message:
        return state(i)

    @override
    def shut(self, viewer: Viewer) -> None:
        Window.latest.close()

    @override
    def shown(self, viewer: Viewer) -> Message:
        return Float64MultiArray(np.concatenate([[0.0, 0.0], Window.latest.shown, FACTORS]))


def test_no_display_is_an_error_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(glfw, "init", lambda: False)
    viewer = _Subject().make(_Subject().context())
    with pytest.raises(IbrobotError, match=r"no display for .* DISPLAY and WAYLAND_DISPLAY.*; run without"):
        viewer.open()
    viewer.close()


def test_needs_a_simulation() -> None:
    viewer = MujocoViewer(Options(), host_context("window", robot=ROBOT))
    with pytest.raises(IbrobotError, match=r"viewer type mujoco needs a running simulation: \{type: mujoco\}"):
        viewer.open()


@pytest.mark.skipif("DISPLAY" not in os.environ, reason="no display")
def test_a_real_window_opens_follows_and_closes() -> None:
    ctx = _Subject().context()
    assert ctx.bus is not None
    viewer = MujocoViewer(Options(), ctx)
    for _ in range(2):
        viewer.open()
        try:
            for i in range(5):
                ctx.bus.publish(PHYSICS_TOPIC, state(i))
                assert viewer.update()
        finally:
            viewer.close()
        assert not viewer.update()
    glfw.terminate()  # MuJoCo keeps the connection to the display until the process ends
    assert physics_size(WORLD, SCENE) == state(0).data.size
