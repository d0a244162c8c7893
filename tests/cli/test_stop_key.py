"""Esc stops the robot in every view, whatever else reads the keys."""

from __future__ import annotations

import queue
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from ibrobot_core.cli import run
from ibrobot_core.plugins import Registry


class Typed(queue.SimpleQueue[str]):
    """Keys, after which the thread that reads them ends."""

    def get(self, block: bool = True, timeout: float | None = None) -> str:
        key = super().get(block, 60)
        if key == "end":
            raise SystemExit
        return key


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_esc_stops_and_other_keys_reach_the_view_with_the_number_of_stops_before_them() -> None:
    typed, shown = Typed(), list[tuple[str, int]]()
    session: Any = SimpleNamespace(request=SimpleNamespace(keys=lambda: typed), pulses=set(), stops=0)

    def stop() -> None:
        session.stops += 1

    session.emergency_stop = stop
    run._listen(session, lambda key, stops: shown.append((key, stops)))
    for key in ("w", "esc", "repeat:esc", "space", "end"):
        typed.put(key)
    for thread in threading.enumerate():
        if thread.name == "runtime keys":
            thread.join(60)
    assert session.stops == 1
    assert shown == [("w", 0), ("repeat:esc", 1), ("space", 1)]


def test_without_a_plugin_for_terminals_a_run_warns_that_esc_does_not_stop_it(caplog: pytest.LogCaptureFixture) -> None:
    nothing: Any = None  # the robot does not matter
    assert run._terminal(nothing, Registry()) is None
    assert "Esc does not stop the robot" in caplog.text
    assert "pip install ibrobot-terminal" in caplog.text
