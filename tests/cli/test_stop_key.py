"""Esc stops the robot in every view, whatever else reads the keys."""

from __future__ import annotations

import queue
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from ibrobot_core.cli import run
from ibrobot_core.config import load_config
from ibrobot_core.errors import ConfigError
from ibrobot_core.plugins import Registry, discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site


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
    robot: Any = SimpleNamespace(terminal=None)
    assert run._terminal(robot, Registry()) is None
    assert "Esc does not stop the robot" in caplog.text
    assert "pip install ibrobot-terminal" in caplog.text


def test_a_robot_names_one_of_several_terminals(site: Site, robot: Path, caplog: pytest.LogCaptureFixture) -> None:
    site.add("two-terminals", "two_terminals.py")

    def terminal(*overrides: str) -> str:
        registry = discover(site.entry_points())
        return type(run._terminal(load_config(robot, overrides=overrides, registry=registry), registry)).__name__

    assert terminal() == "NoneType"
    assert "name the type of the terminal" in caplog.text
    assert [terminal(f"terminal.type={each}") for each in ("printing", "quiet")] == ["FakeTerminal", "QuietTerminal"]
    with pytest.raises(ConfigError, match=r"terminal\.type: unknown terminal type 'quite', did you mean 'quiet'"):
        terminal("terminal.type=quite")
