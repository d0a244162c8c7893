"""Devices of different plugins in one mode: a leader arm and a gamepad, and keys that must not mean two things."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
import takeovers

from ibrobot_core.config import load_config
from ibrobot_core.errors import ConfigError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

OPENS = "'o' is both gripper_open (keys) and deadman (it)"
GROUPS = "control_modes.teleop.teleop={{arm: {}, gripper: {}}}"


def test_a_leader_moves_the_arm_and_a_gamepad_its_gripper(tmp_path: Path) -> None:
    leader, pad, rng = takeovers.WithLeader(tmp_path), takeovers.WithPad(), random.Random(0)
    devices = f"teleoperation={{web: {{type: web}}, leader: {leader.device}, pad: {pad.device}}}"
    config = load_config(takeovers.CONFIG, sim=True, mode="teleop", overrides=[devices, GROUPS.format("leader", "pad")])
    request = LaunchRequest(lockstep=True, keys=leader.subscribe)
    runtime = Runtime(Session(config, installed_plugins(), request))

    def moved(ticks: int = 60) -> tuple[float, float]:
        """How far arm and gripper went [rad]."""
        before = runtime.session.measured().position
        for _ in range(ticks):
            leader.tick(rng)
            pad.tick(rng)
            assert not runtime.step(), runtime.session.failure_text
        way = np.abs(runtime.session.measured().position - before)
        return float(way[:5].max()), float(way[5])

    runtime.start()
    try:
        moved(20)
        assert max(moved()) < 0.02, "no deadman is pressed"
        leader.engage()
        arm, gripper = moved()
        assert arm > 0.1
        assert gripper < 0.02
        leader.release()
        pad.engage()
        pad.trigger = 1.0
        moved(20)
        arm, gripper = moved()
        assert arm < 0.02
        assert gripper > 0.1
        assert runtime.session.faults == ()
    finally:
        runtime.stop()
        pad.close()
        leader.close()


@pytest.mark.parametrize(
    ("device", "keys", "twice"),
    [
        ("so101_leader, port: /dev/a, calibration: none, deadman_key: o", "{}", OPENS),
        ("imu, port: /dev/a, model: bno08x, deadman_key: o", "{}", OPENS),
        ("imu, port: /dev/a, model: bno08x", "{gripper_open: space}", OPENS.replace("'o'", "'space'")),
        ("imu, port: /dev/a, model: bno08x", "{}", ""),
        ("imu, port: /dev/a, model: bno08x, deadman: cts", "{}", ""),
        ("imu, port: /dev/a, model: bno08x, deadman_key: z", "{}", ""),
    ],
)
def test_a_key_with_two_meanings_is_refused(device: str, keys: str, twice: str) -> None:
    devices = f"it: {{type: {device}}}, keys: {{type: keyboard, cartesian: false, keys: {keys}}}"
    overrides = [f"teleoperation={{web: {{type: web}}, {devices}}}", GROUPS.format("it", "keys")]
    if not twice:
        load_config(takeovers.CONFIG, sim=True, overrides=overrides)
        return
    with pytest.raises(ConfigError) as refused:
        load_config(takeovers.CONFIG, sim=True, overrides=overrides)
    message = f"control_modes.teleop.teleop.gripper: key {twice}; give one of them another key"
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ("{takeover_key: t}", "takeover_key: 't' is wrist_flex+ of it in mode model_inference, where it also takes the "
         "robot from the policy; give one of them another key"),
        ("{keep: highlights, highlight_key: o}", "highlight_key: 'o' is gripper_open of it in mode model_inference, "
         "where it also begins a highlight; give one of them another key"),
        ("{keep: highlights, highlight_key: enter}", "highlight_key: 'enter' is the takeover_key, too; give one of "
         "them another key"),
        ("{takeover_key: tab}", "takeover_key: key 'tab' is both takeover and, in every run, start and "
         "end of an episode"),
        ("{keep: highlights, highlight_key: f11}", "highlight_key: key 'f11' is both begin and end of a highlight "
         "and, in every run, end of an episode"),
        ("{highlight_key: o}", ""),
    ],
)  # fmt: skip
def test_a_key_of_takeovers_that_also_jogs_is_refused(episodes: str, message: str) -> None:
    overrides = [
        "teleoperation={web: {type: web}, it: {type: keyboard, cartesian: false}}",
        "control_modes.teleop.teleop=it",
        "control_modes.model_inference.inference={model: scripted_pick, intervene: it}",
        f"episodes={episodes}",
    ]
    if not message:
        load_config(takeovers.CONFIG, sim=True, overrides=overrides)
        return
    with pytest.raises(ConfigError) as refused:
        load_config(takeovers.CONFIG, sim=True, overrides=overrides)
    assert f"episodes.{message}" in str(refused.value)
