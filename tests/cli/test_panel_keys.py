"""The panel goes on while a key's work takes long, e.g. a reset that sets up two leader arms again."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from ibrobot_core.cli import run
from ibrobot_core.run_hooks import RunHooks

Rows = list[tuple[str, str]]


class Rig:
    """A panel with a runtime whose reset waits for `answer` and raises `error` if set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, stack: ExitStack) -> None:
        self.drawn: list[Rows] = []
        self.begun, self.answer, self.failed = threading.Event(), threading.Event(), threading.Event()
        self.error: Exception | None = None
        self.failures: list[tuple[str, Exception]] = []
        monkeypatch.setattr(run, "_log_to", lambda handler: None)
        monkeypatch.setattr(run, "_listen", lambda session, take: setattr(self, "press", take))
        monkeypatch.setattr(run, "panel", lambda session, log, rates, help_text, rows: self._draw(rows))
        session: Any = SimpleNamespace(
            request=SimpleNamespace(lockstep=False), stops=0, mode_keys={}, sensors=[], fail=self._fail
        )
        monkeypatch.setattr(run, "RecentRates", lambda: SimpleNamespace(sample=lambda session: None))
        runtime: Any = SimpleNamespace(session=session, reset=self._reset)
        self.panel = run._Panel(runtime, RunHooks(), stack, err=True)

    def press(self, pressed: tuple[str, int]) -> None:
        """Replaced by the panel's own."""

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
    rig.press(("f10", 0))
    rig.show()
    assert rig.begun.wait(60)
    assert rig.show() == [("now", "resetting …")]
    assert rig.show() == [("now", "resetting …")]


def test_a_bug_in_the_work_of_a_key_ends_the_run(rig: Rig) -> None:
    rig.error = ValueError("odd")
    rig.answer.set()
    rig.press(("f10", 0))
    rig.show()
    assert rig.failed.wait(60)
    assert rig.failures == [("resetting", rig.error)]
