"""Esc stops the robot in every view, whatever else reads the keys."""

from __future__ import annotations

import queue
import threading
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from ibrobot_core.cli import run
from ibrobot_core.run_hooks import RunHooks


class Typed(queue.SimpleQueue[str]):
    """Keys, after which the thread that reads them ends."""

    def get(self, block: bool = True, timeout: float | None = None) -> str:
        key = super().get(block, 60)
        if key == "end":
            raise SystemExit
        return key


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("view", ["_Lines", "_Panel"])
def test_esc_stops_in_every_view(view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    typed, stopped = Typed(), threading.Event()
    monkeypatch.setattr(run, "_log_to", lambda handler: None)
    session: Any = SimpleNamespace(
        request=SimpleNamespace(keys=lambda: typed), pulses=set(), stops=0, emergency_stop=stopped.set
    )
    with ExitStack() as stack:
        getattr(run, view)(SimpleNamespace(session=session), RunHooks(), stack, err=True)
        for key in ("w", "space", "esc", "end"):
            typed.put(key)
        assert stopped.wait(60)
    for thread in threading.enumerate():
        if thread.name == "runtime keys":
            thread.join(60)
