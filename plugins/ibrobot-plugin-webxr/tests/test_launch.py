"""Simulated arms driven through the page, as the how-to configures them, in lockstep."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import yaml

from ibrobot_core.api import Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

from .browser import Browser, hand

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(find_spec("ibrobot_mujoco") is None, reason="needs ibrobot-plugin-mujoco"),
]
ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "how-to" / "drive-with-a-phone.md"


def documented(mode: str) -> list[str]:
    """The overrides that add the how-to's YAML of a mode to a robot, with any free port."""
    blocks = map(yaml.safe_load, re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))
    block = next(each for each in blocks if mode in each.get("control_modes", {}))
    for device in block["teleoperation"].values():
        device["port"] = 0
    return [f"{section}.{name}={json.dumps(value)}" for section in block for name, value in block[section].items()]


@attrs.define
class Run:
    """A run, and the page that drives it."""

    runtime: Runtime
    browser: Browser
    sent: int = 0

    def send(self, **hands: Any) -> None:
        self.sent += 1
        self.browser.send_hands(self.sent, **hands)
        assert not self.runtime.step()
        assert not self.runtime.step()

    @property
    def position(self) -> Vector:
        return self.runtime.session.measured().position.copy()


Start = Callable[[str, str], Run]


@pytest.fixture
def start() -> Iterator[Start]:
    made: list[Run] = []

    def start(robot: str, mode: str) -> Run:
        registry = installed_plugins()
        path = ROOT / "configs" / robot
        overrides = [*documented(mode), "peripherals=[]", "contract.observations=[]"]  # no cameras to render
        config = load_config(path, sim=True, mode=mode, overrides=overrides, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, seed=3)))
        runtime.start()
        address = re.search(r"https://\S+", runtime.session.command_source.help())
        assert address is not None
        made.append(Run(runtime, Browser(address[0]).log_in().connect()))
        return made[-1]

    yield start
    for run in made:
        run.browser.__exit__(None, None, None)
        run.runtime.stop()


def test_a_hand_moves_the_simulated_arm_and_its_gripper(start: Start):
    run = start("so101_blind.yaml", "phone")
    for _ in range(10):
        run.send(right=hand())
    before = run.position
    for i in range(50):
        run.send(right=hand(clutch=True, gripper=0.0 if i < 5 else 0.3, position=[0, 1 + 0.001 * i, 0]))
    way = run.position - before
    assert np.abs(way[:5]).max() > 0.05
    assert way[5] > 0.3
    run.browser.disconnect()
    for _ in range(20):
        run.runtime.step()
    held = run.position
    for _ in range(50):
        run.runtime.step()
    np.testing.assert_allclose(run.position, held, atol=2e-3)
    assert run.runtime.session.faults == ()


def test_two_hands_move_two_arms(start: Start):
    run = start("bi_so101.yaml", "hands")
    for _ in range(10):
        run.send(left=hand(), right=hand())
    before = run.position
    for i in range(50):
        run.send(left=hand(clutch=True, position=[0, 1 + 0.001 * i, 0]), right=hand(position=[0, 1 - 0.001 * i, 0]))
    way = np.abs(run.position - before)
    assert way[:6].max() > 0.05
    assert way[6:].max() < 0.01, "the right clutch is not held"
    for i in range(50):
        run.send(left=hand(), right=hand(clutch=True, position=[0.001 * i, 1, 0]))
    assert np.abs(run.position - before)[6:].max() > 0.05
    assert run.runtime.session.faults == ()
