"""An operator's keys and buttons, and the flags of `ibrobot record`, with made-up runs in lockstep."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest
from ibrobot_data.cues import Cues
from ibrobot_data.episode_service import CANCEL, START, EpisodeService
from ibrobot_data.operator import Operator
from ibrobot_testing.fakes import FakeRecorder
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import NotSupported, RecorderError
from ibrobot_core.app import LaunchRequest, Runtime, Session, SourceWorker, installed_plugins, load_config

ROBOT = """\
robot:
  name: mini
  joints:
    - {name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
    - {name: grip, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}
  groups: {arm: [pan], gripper: [grip]}
hardware: {type: arm}
simulation: {type: scene}
executors:
  arm_position: {type: position, group: arm}
  grip_position: {type: position, group: gripper}
models:
  net: {type: net}
control_modes:
  teleop: {executors: [arm_position, grip_position], teleop: stick}
  policy: {executors: [arm_position, grip_position], inference: {model: net}, dispatch: {watermark: 5}}
  idle: {executors: [arm_position]}
  pad: {executors: [arm_position, grip_position], teleop: {arm: stick, gripper: pad}}
default_control_mode: teleop
teleoperation:
  stick: {type: stick}
  pad: {type: pad}
contract:
  rate_hz: 25
  max_duration_s: 1
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.grip]}
  actions:
    - {executor: arm_position, topic: /arm/commands}
    - {executor: grip_position, topic: /grip/commands}
control: {rate_hz: 50, stop: hold}
recording: {type: lines, root: kept, dataset: pick}
"""


@attrs.frozen
class Recording:
    """A run and its operator."""

    runtime: Runtime
    operator: Operator

    @property
    def service(self) -> EpisodeService:
        service = self.runtime.session.episodes
        assert isinstance(service, EpisodeService)
        return service

    @property
    def finished(self) -> bool:
        return self.runtime.session.finished.is_set()

    @property
    def ended(self) -> list[tuple[int, str]]:
        """Number and outcome of each episode that has ended."""
        ended: list[tuple[int, str]] = sys.modules["arms"].ENDED
        return ended

    def keys(self, *keys: str) -> None:
        for key in keys:
            assert self.operator.key(key), key

    def press(self, *events: str) -> None:
        """Press buttons of the device."""
        sys.modules["arms"].STICKS[-1].events = events

    def step(self, count: int) -> None:
        """Run for some ticks, or to the end of the run."""
        for _ in range(count):
            self.operator.step()
            if self.runtime.step():
                return


Record = Callable[..., Recording]


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Record]:
    """Starts runs with an operator; stops those that a test leaves running."""
    made: list[Runtime] = []
    monkeypatch.chdir(tmp_path)
    Path("mini.yaml").write_text(ROBOT)

    def start(mode: str = "teleop", **asked: Any) -> Recording:
        registry = installed_plugins()
        config = load_config("mini.yaml", mode=mode, sim=True, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, by_operator=True)))
        made.append(runtime)
        flags = {"count": None, "reset_time_s": 0.0, "prompt": None, "auto": False, "keys": True, **asked}
        service = runtime.session.episodes
        assert isinstance(service, EpisodeService)
        operator = Operator(runtime.session, service, **flags)
        runtime.start()
        for _ in range(5):
            assert not runtime.step()
        return Recording(runtime, operator)

    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        yield start
        for runtime in made:
            runtime.stop()


def test_tab_asks_for_a_prompt_and_enter_begins(record: Record):
    run = record()
    run.keys("tab", "h", "o", "p", "backspace", "space", "!")
    assert "ho !_" in run.operator.rows()[0][1]
    assert not run.service.running
    run.keys("enter")
    run.step(2)
    assert run.service.running
    assert "recording “ho !”" in run.operator.line()
    run.keys("tab")
    assert (run.service.running, run.service.saved) == (False, 1)
    run.keys("tab")
    assert "recording “ho !”" in run.operator.line(), "the prompt is that of the session"
    run.keys("f12", "f11", "tab")
    assert not run.service.running, "Tab goes back from the question for another prompt"
    assert not run.operator.key("a"), "letters belong to the mode again"


def test_the_arm_holds_while_a_prompt_is_typed(record: Record):
    run = record()
    source = run.runtime.session.command_source
    assert isinstance(source, SourceWorker)
    assert source.active
    run.keys("tab", "w")
    assert not source.active
    run.keys("enter")
    assert source.active


def test_no_frame_of_a_paused_arm_is_recorded(record: Record):
    run = record()
    run.keys("tab", "enter")
    (stick,) = sys.modules["arms"].STICKS[-1:]
    stick.pressed = False
    run.step(20)
    assert not run.service.running
    assert run.operator.rows()[0][1] == "ready: recording begins when the robot follows you"
    stick.pressed = stick.approaching = True
    run.step(20)
    assert not run.service.running, "the robot is still on its way to the device's pose"
    stick.approaching = False
    run.step(2)
    assert run.service.running
    stick.pressed = False
    run.step(5)
    assert run.service.running, "a pause within an episode belongs to it"


@pytest.mark.parametrize("key", ["tab", "f12"])
def test_an_episode_that_waits_for_the_robot_to_follow_can_be_cancelled(record: Record, key: str):
    run = record(prompt="pick")
    sys.modules["arms"].STICKS[-1].pressed = False
    run.step(10)
    run.keys("tab")
    assert run.operator.help() == "Tab goes back"
    run.keys(key)
    sys.modules["arms"].STICKS[-1].pressed = True
    run.step(5)
    assert not run.service.running


def test_an_emergency_stop_cancels_an_episode_that_waits(record: Record):
    run = record(prompt="pick")
    sys.modules["arms"].STICKS[-1].pressed = False
    run.step(10)
    run.keys("tab")
    run.runtime.session.emergency_stop()
    run.step(3)
    assert ("", "not recording: emergency stop; reset it first") in run.operator.rows()
    assert not run.service.waiting


def test_redo_replaces_the_last_episode_once_the_new_one_is_saved(record: Record):
    run = record(prompt="pick", count=2, reset_time_s=0.1)
    assert not run.operator.key("backspace"), "there is no episode to record again"
    kept = lambda: sorted(path.name for path in Path("kept/pick/episodes").iterdir())  # noqa: E731
    for keys in (("tab", "tab"), ("backspace", "f12")):
        for key in keys:
            run.keys(key)
            run.step(3)
    assert (kept(), run.service.saved) == (["episode_000001"], 1), "the new one was discarded, the old one stays"
    for key in ("backspace", "backspace", "tab"):
        run.keys(key)
        run.step(3)
    assert (kept(), run.service.saved) == (["episode_000003"], 1)
    assert not run.finished
    for key in ("tab", "tab", "backspace"):
        run.keys(key)
        run.step(2)
    assert run.service.running, "the last one, in the pause after it"
    run.keys("f11")
    run.step(10)
    assert not run.finished
    assert run.operator.help() == "Tab end of the session   Backspace again"
    assert ("record", "all episodes are saved; the session ends in 8 s") in run.operator.rows()
    run.step(410)
    assert run.finished
    assert (kept(), run.service.saved) == (["episode_000003", "episode_000005"], 2)
    summary = run.runtime.summary()
    assert (summary["episodes"], summary["successes"], summary["unjudged"]) == (2, 1, 0), (
        "those that were replaced are not"
    )


def test_the_session_ends_at_once_if_the_person_says_so_or_is_not_there(record: Record):
    run = record(prompt="pick", count=1)
    run.keys("tab", "tab")
    run.step(5)
    assert not run.finished
    run.keys("tab")
    assert run.finished
    alone = record("pad", prompt="pick", count=1, keys=False)
    for button in ("start", "success"):
        alone.press(button)
        alone.step(5)
    assert alone.finished


def test_cues_of_an_episode(record: Record, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("ibrobot_data.operator.ENDING_S", 0.5)
    run = record(prompt="pick")
    heard: list[tuple[str, float]] = []
    run.service.on_cue.append(lambda cue: heard.append((cue, run.service.elapsed_s())))
    run.keys("tab")
    run.step(60)
    assert [cue for cue, _ in heard] == ["start", "ending", "saved"]
    assert heard[1][1] == pytest.approx(0.5, abs=0.03)
    run.keys("tab", "f12")
    run.step(3)
    assert [cue for cue, _ in heard[3:]] == ["start"], "a discarded one is not saved"
    assert run.service.status().cues == 4


def test_cues_ring_the_terminal_or_are_spoken_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    read, write = os.pipe()
    bells = Cues("beep", write)
    bells.play("start")
    bells.play("ending")
    for _ in range(5):
        bells.step()
    assert os.read(read, 99) == 3 * b"\a"
    os.close(read)
    os.close(write)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(NotSupported, match=r"cues by speech: none of spd-say, say, .* is installed; apt-get install"):
        Cues("speech", None)
    program = tmp_path / "espeak"
    program.write_text(f'#!/bin/sh\necho "$1" >> {tmp_path}/spoken\n')
    program.chmod(0o755)
    voice = Cues("speech", None)
    voice.play("start")
    voice.play("saved")
    while voice.playing:
        voice.step()
    assert (tmp_path / "spoken").read_text().split() == ["recording", "saved"]


def test_changes_of_the_session_are_reported(record: Record):
    heard: list[Any] = []
    run = record(prompt="pick", count=3, report=heard.append)
    run.step(3)
    assert [(each.saved, each.wanted, each.state) for each in heard] == [(0, 3, "waiting: Tab starts")]
    run.keys("tab")
    run.step(2)
    assert heard[-1].state.startswith("recording “pick”")
    run.keys("tab")
    run.step(1)
    assert heard[-1].saved == 1
    count = len(heard)
    run.operator.summary_rows()
    assert [(each.saved, each.state) for each in heard[count:]] == [(1, "ended")]


def test_failure_and_discard(record: Record):
    run = record(prompt="pick")
    for end in ("f11", "f12"):
        run.keys("tab")
        run.step(2)
        run.keys(end)
        run.step(2)
    assert run.ended == [(1, "failure"), (2, "discarded")]
    assert run.service.saved == 1


def test_buttons_of_the_device_begin_and_end_episodes(record: Record):
    run = record(prompt="pick")
    for event in ("start", "success", "start", "failure", "start", "discard"):
        run.press(event)
        run.step(3)
        assert run.service.running == (event == "start")
    assert run.ended == [(1, "success"), (2, "failure"), (3, "discarded")]
    assert run.service.saved == 2


def test_a_button_without_an_episode_to_end_says_so(record: Record):
    run = record(prompt="pick")
    run.press("failure")
    run.step(3)
    assert ("", "failure: no episode is being recorded") in run.operator.rows()


def test_buttons_do_not_end_automatic_episodes(record: Record, caplog: pytest.LogCaptureFixture):
    run = record(continuous=True, keys=False, prompt="watch")
    run.step(3)
    run.press("discard")
    run.step(3)
    assert run.service.running
    assert "discard: this run begins and ends its episodes automatically" in caplog.text


def test_unattended_episodes_pause_and_end_with_the_count(record: Record):
    run = record(auto=True, count=2, reset_time_s=0.5, prompt="pick")
    run.step(50 + 2)
    assert run.service.saved == 1
    assert "reset the scene" in run.operator.line()
    run.step(200)
    assert run.finished
    assert run.operator.summary_rows()[0][1].startswith("2 of 2 episodes into")
    assert run.ended == [(1, "unknown"), (2, "unknown")]


def test_an_unattended_episode_with_an_emergency_stop_is_replaced(record: Record):
    run = record(auto=True, count=1, prompt="pick")
    run.step(10)
    run.runtime.session.emergency_stop()
    run.step(100)
    assert run.ended == [(1, "failure")], "it ends at once, and none begins before the reset"
    run.runtime.reset()
    run.step(200)
    assert run.finished
    assert run.ended == [(1, "failure"), (2, "unknown")]
    assert run.runtime.summary()["disturbed"] == 1


def test_reason_for_not_beginning_is_shown(record: Record):
    run = record("idle", auto=True, prompt="")
    run.step(3)
    rows = run.operator.rows()
    assert "topics are silent: /grip/commands" in rows[1][1]
    assert [heading for heading, _ in rows] == ["record", "", "saved", "lost", "disk", "topics"]


@pytest.mark.parametrize("auto", [False, True])
def test_a_full_disk_ends_the_episode_and_it_does_not_count(
    record: Record, monkeypatch: pytest.MonkeyPatch, auto: bool
):
    def full(*_: object) -> None:
        raise RecorderError("its disk has 1 MiB left")

    run = record(prompt="pick", auto=auto, count=1)
    if not auto:
        run.keys("tab")
    run.step(3)
    assert run.service.running
    with monkeypatch.context() as patch:
        patch.setattr(FakeRecorder, "write", full)
        run.step(3)
    assert (run.service.running, run.service.saved) == (False, 0)
    assert ("", "recording ended: its disk has 1 MiB left") in run.operator.rows()
    assert run.finished == auto, "the robot goes on where an operator is there"
    if not auto:
        run.keys("tab")
        run.step(3)
        assert run.service.running, "there is room again"
        assert "" not in dict(run.operator.rows())


def test_unattended_the_run_ends_without_room_for_another_episode(record: Record, monkeypatch: pytest.MonkeyPatch):
    run = record(auto=True, prompt="pick")
    run.step(40)
    monkeypatch.setattr(run.service, "free_bytes", lambda: 1)
    run.step(40)
    assert run.finished
    faults = run.runtime.session.outcome.faults
    assert (run.service.saved, len(faults)) == (1, 1)
    assert "0 MiB left" in faults[0]


def test_continuous_is_one_episode_to_the_end_of_the_run(record: Record):
    run = record(continuous=True, keys=False, prompt="watch")
    run.step(120)
    assert run.service.elapsed_s() > 2 * run.runtime.session.config.contract.max_duration_s
    assert run.operator.line().startswith("recording “watch”, 2 s, saved")
    assert not run.operator.key("tab")
    run.runtime.stop()
    assert run.ended == [(1, "unknown")]
    assert run.service.saved == 1
    assert [path.name for path in Path("kept/pick/episodes").iterdir()] == ["episode_000001"]


def test_continuous_is_refused_where_the_mode_has_episodes(record: Record):
    with pytest.raises(NotSupported, match="mode policy begins and ends its episodes itself") as caught:
        record("policy", continuous=True)
    assert caught.value.exit_code == 2


def test_without_a_terminal_the_buttons_of_a_device_begin_and_end_episodes(record: Record):
    run = record("pad", keys=False, prompt="pick")
    for event in ("start", "success"):
        run.press(event)
        run.step(3)
    assert run.ended == [(1, "success")]


def test_without_a_terminal_other_programs_begin_and_end_episodes(record: Record):
    Path("mini.yaml").write_text(f"{ROBOT}phone: {{}}\n")
    run = record(keys=False, prompt="pick")
    bus = run.runtime.session.bus
    bus.call(START, "place")
    run.step(3)
    bus.call(CANCEL)
    run.step(3)
    assert (run.ended, run.service.saved) == ([(1, "unknown")], 1)


def test_nobody_can_begin_an_episode_without_keys_buttons_and_auto(record: Record):
    message = (
        "nothing can begin an episode: there is no terminal for keys, no device of mode teleop has a button `start`"
    )
    with pytest.raises(
        NotSupported, match=f"{message}, and no other program may call /record_episode/start; add --"
    ) as caught:
        record(keys=False)
    assert caught.value.exit_code == 2
