"""A takeover and a handback with each device that can intervene."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import takeovers
from ibrobot_testing.site import made_up_site

from ibrobot_core.config import load_config
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("device", list(takeovers.PERSONS))
def test_a_takeover_is_smooth_labelled_and_recorded(
    device: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wander.py").write_text(takeovers.WANDER)
    with made_up_site(tmp_path / "site", tmp_path, monkeypatch) as site:
        site.add("wander", "wander.py")
        found = takeovers.measure(device, takeovers=1, seed=3)
    assert takeovers.is_good(found), found
    assert found["intervention_rows"] > 5


def test_moving_a_leader_without_a_deadman_takes_the_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wander.py").write_text(takeovers.WANDER)
    leader, rng = takeovers.WithLeader(tmp_path), random.Random(0)
    overrides = [
        "models={wander: {type: wander}}",
        "control_modes.model_inference.inference={model: wander, intervene: it}",
        "control_modes.teleop.teleop=it",
        f"teleoperation={{web: {{type: web}}, it: {leader.device[:-1]}, deadman: none}}}}",
        "episodes={takeover: deadman}",
        "contract.max_duration_s=100",
    ]
    with made_up_site(tmp_path / "site", tmp_path, monkeypatch) as site:
        site.add("wander", "wander.py")
        config = load_config(takeovers.CONFIG, overrides=overrides, sim=True)
        request = LaunchRequest(lockstep=True, keys=leader.subscribe)
        runtime = Runtime(Session(config, installed_plugins(), request))
        commands = []

        def commanders(ticks: int) -> list[str]:
            for _ in range(ticks):
                leader.tick(rng)
                assert not runtime.step(), runtime.session.failure_text
                assert runtime.session.state is not None
                commands.append(runtime.session.state.command)
            return [item.message.data for item in words.drain()]  # type: ignore[attr-defined]

        runtime.start()
        try:
            words = runtime.session.bus.subscribe("/commander", 1000)
            words.drain()
            assert set(commanders(100)) == {"policy"}
            leader.engage()
            found = commanders(150)
            assert (found[0], found[-1]) == ("policy", "operator")
            leader.toggle()
            assert commanders(150)[-1] == "policy", "the key gives it back"
            assert runtime.session.faults == ()
        finally:
            runtime.stop()
            leader.close()
    velocity = np.diff(commands, axis=0) * 100
    assert (np.abs(velocity) <= 1.001 * config.robot.max_velocity).all()
    assert (np.abs(np.diff(velocity, axis=0)) * 100 <= 1.001 * config.robot.max_acceleration).all()
