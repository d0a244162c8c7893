"""Keys of the panel: those pressed before a stop do nothing, and it goes on while the work of a key takes long."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest
from ibrobot_terminal import run_terminal
from ibrobot_terminal.authority import Authority
from ibrobot_terminal.run_terminal import Panel

from ibrobot_core.app import RunHooks

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime

Rows = list[tuple[str, str]]


class Rig:
    """A panel with a runtime whose reset, e.g. of two leader arms, waits for `answer` and raises `error` if set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
        self.drawn: list[Rows] = []
        self.begun, self.answer, self.failed = threading.Event(), threading.Event(), threading.Event()
        self.error: Exception | None = None
        self.failures: list[tuple[str, Exception]] = []
        monkeypatch.setattr(run_terminal, "panel", lambda display, log, help_text, rows: self._draw(rows))
        session: Any = SimpleNamespace(
            request=SimpleNamespace(lockstep=False), stops=0, mode_keys={}, sensors={}, state=None, fail=self._fail
        )
        session.clock = SimpleNamespace(now_ns=lambda: 0)
        session.bus = SimpleNamespace(latched=dict, serves=lambda name: False)
        session.config = SimpleNamespace(teleoperation={}, robot=None)
        session.authority = Authority(session)
        runtime: Any = SimpleNamespace(session=session, reset=self._reset)
        self.panel = Panel(runtime, RunHooks(), stack, err=True)

    def show(self) -> Rows:
        """The rows that the panel draws now."""
        self.panel._next_s = 0.0
        self.panel.show()
        return self.drawn[-1]

    def _draw(self, rows: Rows) -> str:
        self.drawn.append(rows)
        return ""

    def _reset(self, stops: int) -> None:
        self.begun.set()
        assert self.answer.wait(60)
        if self.error is not None:
            raise self.error

    def _fail(self, name: str, error: Exception) -> None:
        self.failures.append((name, error))
        self.failed.set()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with ExitStack() as stack:
        each = Rig(monkeypatch, stack)
        stack.callback(each.answer.set)
        yield each


def test_the_panel_shows_the_robot_during_a_reset_and_says_that_it_resets(rig: Rig) -> None:
    rig.panel.press("f10", 0)
    rig.show()
    assert rig.begun.wait(60)
    assert rig.show() == [("now", "resetting …")]
    assert rig.show() == [("now", "resetting …")]


def test_repeats_and_releases_are_no_presses(rig: Rig) -> None:
    rig.panel.press("repeat:f10", 0)
    rig.panel.press("release:f10", 0)
    assert rig.show() == []
    assert not rig.begun.is_set()


def test_a_bug_in_the_work_of_a_key_ends_the_run(rig: Rig) -> None:
    rig.error = ValueError("odd")
    rig.answer.set()
    rig.panel.press("f10", 0)
    rig.show()
    assert rig.failed.wait(60)
    assert rig.failures == [("resetting", rig.error)]


class TestStops:
    @pytest.fixture
    def run(self, runs: Runs) -> Runtime:
        return runs.start("control_modes.teleop.teleop=lever", mode="teleop")

    @pytest.fixture
    def panel(self, run: Runtime) -> Iterator[Panel]:
        with ExitStack() as stack:
            yield Panel(run, RunHooks(), stack, err=True)

    @staticmethod
    def stopped(run: Runtime) -> bool:
        for _ in range(30):
            run.step()
        assert run.session.state is not None
        return run.session.state.estop

    def test_keys_pressed_before_one_do_nothing_after_it(self, run: Runtime, panel: Panel, caplog) -> None:
        for key in ("f10", "f6"):
            panel.press(key, run.session.stops)
        run.session.emergency_stop()
        panel.handle_keys()
        assert self.stopped(run)
        assert run.session.mode == "teleop"
        assert "f10 was pressed before the emergency stop, which cancels it" in caplog.text
        panel.press("f10", run.session.stops)
        panel.handle_keys()
        assert not self.stopped(run)

    def test_keys_pressed_before_one_of_another_person_do_nothing_after_it(self, run: Runtime, panel: Panel) -> None:
        run.session.emergency_stop()
        panel.press("f10", run.session.stops)
        run.session.bus.call("/estop")
        panel.handle_keys()
        assert self.stopped(run)
