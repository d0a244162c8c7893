"""Sensors that this machine cannot run: a run without them says so, and what needs them is refused with the remedy."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import pytest

from ibrobot_core.errors import ComponentFailed, MissingDependency

if TYPE_CHECKING:
    from fake_runs import Runs

REMEDY = "no OpenGL; sudo apt-get install libegl1 libopengl0"
SEER = ("models.seer={type: seeing}", "control_modes.policy.inference.model=seer")


@pytest.fixture
def bare(runs: Runs) -> Runs:
    """Runs on a machine without OpenGL, which the simulation's cameras need."""
    runs.make()  # imports the parts
    runs.parts.TROUBLE["no OpenGL"] = True
    return runs


@pytest.mark.parametrize("mode", ["policy", "teleop", "plan", "idle"])
def test_a_mode_without_cameras_runs_without_them(bare: Runs, mode: str, caplog: pytest.LogCaptureFixture):
    runtime = bare.start(mode=mode)
    for _ in range(5):
        runtime.step()
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warnings[0] == f"running without camera top, camera side: {REMEDY}"
    assert all("goals of trajectories" in each for each in warnings[1:])
    assert runtime.summary()["absent"] == {"top": REMEDY, "side": REMEDY}
    assert bare.parts.MADE.keys() & {"top", "side"} == set()


def test_a_mode_without_cameras_runs_while_one_is_not_connected(runs: Runs, caplog: pytest.LogCaptureFixture):
    runs.make()  # imports the parts
    runs.parts.TROUBLE["unplugged"] = True
    runtime = runs.start(*SEER, mode="teleop")
    assert "running without camera top, camera side: /dev/video0: there is no such device; plug it in" in caplog.text
    with pytest.raises(ComponentFailed, match="model 'seer' needs camera top: /dev/video0: there is no such device"):
        runtime.switch_mode("policy")


def test_the_plan_and_the_diagnostics_name_what_is_absent(bare: Runs):
    runtime = bare.start(mode="teleop")
    assert f"without camera top, camera side: {REMEDY}" in runtime.plan.lines()
    diagnostics = runtime.session.bus.subscribe("/diagnostics", 1)
    runtime.step()
    received = diagnostics.get()
    diagnostics.close()
    assert received is not None
    groups = {status.name: status.values for status in received.message.status}  # type: ignore[attr-defined]
    assert [(pair.key, pair.value) for pair in groups["sensor top"]] == [("missing", REMEDY)]


def test_nothing_is_said_where_nothing_is_absent(runs: Runs, caplog: pytest.LogCaptureFixture):
    runtime = runs.start(mode="teleop")
    assert "without" not in caplog.text
    assert runtime.summary()["absent"] == {}


def test_a_policy_that_sees_is_refused_before_anything_is_powered(bare: Runs):
    runtime = bare.make(*SEER)
    with pytest.raises(ComponentFailed) as refused:
        runtime.start()
    assert str(refused.value) == f"model:seer: model 'seer' needs camera top: {REMEDY}"
    assert refused.value.exit_code == 2
    assert "simulation" not in bare.parts.MADE


def test_a_switch_to_a_policy_that_sees_is_refused_and_the_present_mode_goes_on(bare: Runs):
    runtime = bare.start(*SEER, mode="teleop")
    with pytest.raises(ComponentFailed, match=r"model 'seer' needs camera top: no OpenGL; sudo apt-get install"):
        runtime.switch_mode("policy")
    runtime.step()
    assert runtime.session.mode == "teleop"
    runtime.raise_failure()


@pytest.mark.parametrize("topics", ["contract", "all", "[/joint_states, /camera/top/image_raw]"])
def test_a_recording_that_wants_pictures_is_refused(bare: Runs, topics: str):
    with pytest.raises(MissingDependency, match=r"the recording needs camera top.*: no OpenGL; sudo apt-get install"):
        bare.make(f"recording={{type: lines, topics: {topics}}}", mode="teleop")


def test_a_recording_of_other_topics_is_not(bare: Runs):
    bare.start("recording={type: lines, topics: [/joint_states]}", mode="teleop")


def test_a_sensor_whose_topic_is_unknown_is_never_left_out(bare: Runs):
    """Nobody could say what needs its messages."""
    with pytest.raises(MissingDependency, match="no OpenGL"):
        bare.make("peripherals=[{name: gyro, kind: imu, type: imu}]", "contract.observations=[]", mode="teleop")
