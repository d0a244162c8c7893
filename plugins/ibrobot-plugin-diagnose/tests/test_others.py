"""Quality tools of other projects as causes: what they flag is shown in their words, and absent ones are absent."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import reload
from types import ModuleType
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.causes import others
from ibrobot_diagnose.diagnosis import diagnose
from made_runs import Run, window_of

DEMO = window_of(Run(seed=5, acts=False, cameras=(), seconds=4))
TOOLS = {"lerobot_doctor": others.LerobotDoctor, "lerobot_lint": others.LerobotLint}


@attrs.frozen
class Message:
    """As both tools give them."""

    message: str = ""
    check: str = ""
    severity: str = ""


def stand_ins(
    monkeypatch: pytest.MonkeyPatch, reasons: list[str], computes: Callable[[], object] = lambda: None
) -> list[Any]:
    """Modules in place of both tools, which compute this and say these reasons of every episode; what they get."""
    given: list[Any] = []

    def per_episode(dataset: Any) -> Any:
        given.append(dataset["episodes_data"][0])
        computes()
        flagged = [Message(f"Episode 0: {'; '.join(reasons)}")] if reasons else []
        return Message_list([Message("1/1 episode(s) flagged"), *flagged])

    class Registry:
        def run_all(self, episode: Any, index: int) -> list[Message]:
            given.append(episode)
            computes()
            return [Message(reason, "CHECK", "warning") for reason in reasons] + [Message("fine", "OTHER", "info")]

    @attrs.frozen
    class Message_list:
        messages: list[Message]

    made = {
        "lerobot_doctor": {}, "lerobot_doctor.checks": {},
        "lerobot_doctor.checks.per_episode": {"check_per_episode": per_episode},
        "lerobot_doctor.dataset_loader": {
            "DatasetInfo": lambda *values, **named: named, "EpisodeData": lambda *values: values,
            "LoadedDataset": lambda *values, **named: named,
        },
        "lerobot_lint": {},
        "lerobot_lint.config": {"detect_profile_name": lambda joints: None, "load_profile": lambda name: name},
        "lerobot_lint.engine": {"build_episode_check_registry": lambda profile: Registry()},
        "lerobot_lint.types": {"EpisodeData": lambda *values, **named: values},
    }  # fmt: skip
    for name, members in made.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(others, "version", lambda package: "1.2")
    others._checks_of_lint.cache_clear()
    return given


@pytest.mark.parametrize("tool", TOOLS)
def test_what_a_tool_flags_is_shown_in_its_words(tool, monkeypatch):
    given = stand_ins(monkeypatch, ["it jumps", "it is short"])
    (finding,) = diagnose(DEMO, Reference(), [TOOLS[tool]()]).findings
    assert finding.evidence.text.startswith(f"{tool.replace('_', '-')} 1.2 flags this episode: ")
    assert "it jumps" in finding.evidence.text
    assert "it is short" in finding.evidence.details[0]
    ((*_, states, actions),) = ([each for each in _arrays(given[0]) if each.ndim == 2],)
    assert states.shape == actions.shape == (len(DEMO.ticks_ns), 4)


def _arrays(given: Any) -> list[Any]:
    found = given[1].values() if isinstance(given[1], dict) else given
    return [each for each in found if isinstance(each, np.ndarray)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("tool", TOOLS)
def test_numbers_of_a_joint_that_stands_still_warn_nobody(tool, monkeypatch):
    """As lerobot-lint divides by its deviation."""
    stand_ins(monkeypatch, ["it stands"], lambda: np.corrcoef(np.zeros(5), np.arange(5.0)))
    assert diagnose(DEMO, Reference(), [TOOLS[tool]()]).first == tool


@pytest.mark.parametrize("tool", TOOLS)
def test_episode_that_a_tool_does_not_flag_is_not_listed(tool, monkeypatch):
    stand_ins(monkeypatch, [])
    assert diagnose(DEMO, Reference(), [TOOLS[tool]()]).first == ""


def test_tools_that_are_not_installed_are_no_causes(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    try:
        assert reload(others).CAUSES == ()
    finally:
        monkeypatch.undo()
        reload(others)


@pytest.mark.parametrize("tool", TOOLS)
def test_the_real_tools_take_an_episode(tool):
    pytest.importorskip(tool, reason="needs lerobot-doctor and lerobot-lint")
    others._checks_of_lint.cache_clear()
    state, command = (each.values.copy() for each in (DEMO.state, DEMO.command))
    state[:, 3] = command[:, 3] = 0.2  # a joint that never moves
    command[: len(command) // 2] = command[0]  # and commands that stay the same for half of the time
    frozen = attrs.evolve(
        DEMO, state=attrs.evolve(DEMO.state, values=state), command=attrs.evolve(DEMO.command, values=command)
    )
    assert diagnose(frozen, Reference(), [TOOLS[tool]()]).first == tool
