"""The modes of bundled robots as pages offer them."""

from __future__ import annotations

from typing import Any

import pytest
from ibrobot_web.modes import modes_json

from ibrobot_core.app import find_config, installed_plugins, load_config

REGISTRY = installed_plugins()
SHIPPED = sorted(REGISTRY.shipped_configs())
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(("hardware", "mujoco") not in REGISTRY.entries, reason="needs ibrobot-plugin-mujoco"),
]


def modes(robot: str, *, terminal: bool = False) -> dict[str, Any]:
    """The modes of a bundled robot, simulated if it can be, by name."""
    path = find_config(robot, REGISTRY)
    simulated = "simulation:" in path.read_text(encoding="utf-8")
    config = load_config(path, sim=simulated, registry=REGISTRY)
    return {mode["name"]: mode for mode in modes_json(config, installed_plugins(), terminal=terminal)}


@pytest.mark.parametrize("robot", SHIPPED)
def test_every_bundled_robot_is_driven_from_the_page(robot: str) -> None:
    driven = [mode for mode in modes(robot).values() if mode["jogs"] and not mode["policy"]]
    assert driven
    assert not any(mode["unavailable"] for mode in driven)


def test_modes_are_named_by_what_they_do() -> None:
    labels = {name: mode["label"] for name, mode in modes("so101").items()}
    assert labels["model_inference"] == "run the policy scripted_pick"
    assert labels["teleop"] == "follow the leader arm"
    assert labels["moveit_planning"] == "plan motions"
    assert modes("bi_so101")["web"]["label"] == "drive from the page: left and right"
    assert list(modes("bi_so101")["web"]["jogs"]) == ["page_left", "page_right"]


def test_modes_with_the_same_words_have_their_names() -> None:
    labels = [mode["label"] for mode in modes("so101_scenes").values()]
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("terminal", [False, True])
def test_modes_that_need_a_terminal_say_so(terminal: bool) -> None:
    why = modes("so101", terminal=terminal)["jog"]["unavailable"]
    assert why == ("" if terminal else "keyboard needs a terminal: start the robot in one, with ibrobot launch")
