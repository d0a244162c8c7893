"""`ibrobot identify --excite` moves a simulated arm within its limits, and records what an identification needs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run_here

from ibrobot_core.api import JointState
from ibrobot_core.app import installed_plugins

pytestmark = pytest.mark.integration


def test_excitation_moves_each_joint_and_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    robot = ("so101", "--sim", "--lockstep", "--set", "simulation.scene=empty")
    done = run_here("identify", "--excite", *robot, "--minutes", "0.5", "--events")
    assert done.returncode == 0, done.stderr
    assert "succeeded" in done.stdout
    told = json.loads(done.stdout.splitlines()[-1])
    assert told == {"event": "excited", "dataset": str(Path("episodes/excitation"))}
    reader = installed_plugins().open_episode(tmp_path / told["dataset"] / "episodes/episode_000001")
    try:
        messages = [each.message for each in reader.messages({"/joint_states"})]
    finally:
        reader.close()
    positions = np.array([each.position for each in messages if isinstance(each, JointState)])
    assert len(positions) > 1000
    assert np.ptp(positions, axis=0).min() > 0.4
