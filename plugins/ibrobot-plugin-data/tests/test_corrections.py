"""Takeovers and handbacks in the middle of an episode: who commands, what moves, and by how much."""

from __future__ import annotations

import queue
import random
from typing import TYPE_CHECKING

import attrs
import numpy as np
import pytest

from ibrobot_core.api import EpisodeEnd, EpisodeStart, TeleopError, Vector
from ibrobot_core.app import RequestError

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.fakes import FakeTeleop

    from ibrobot_core.app import Runtime, Subscription

POLICY = "control_modes.policy.inference={{model: net, intervene: {}}}"
SLACK = 1.001
"""Rounding of commands."""


@attrs.define
class Episode:
    """A run with an operator; `commands` has those of every tick [rad]."""

    run: Runtime
    device: FakeTeleop
    labels: Subscription
    commands: list[Vector] = attrs.field(factory=list)

    def ticks(self, count: int) -> list[str]:
        """Run; return who commanded at each tick."""
        for _ in range(count):
            assert not self.run.step(), self.run.session.failure_text
            assert self.run.session.state is not None
            self.commands.append(self.run.session.state.command)
        return [item.message.data for item in self.labels.drain()]  # type: ignore[attr-defined]

    def press(self) -> None:
        self.device.events = ("intervention",)

    def moves(self, ticks: int = 10) -> bool:
        """Whether the commands change."""
        before = len(self.commands)
        self.ticks(ticks)
        return bool(np.ptp(self.commands[before:], axis=0).max() > 1e-4)

    def check_steps(self) -> None:
        """Check that velocity and acceleration of the commands stay within the limits."""
        run = self.run
        robot, dt = run.session.config.robot, 1 / run.session.config.control.rate_hz
        velocity = np.diff(self.commands, axis=0) / dt
        assert (np.abs(velocity) <= SLACK * robot.max_velocity).all()
        acceleration = np.diff(velocity, axis=0) / dt
        assert (np.abs(acceleration) <= SLACK * robot.max_acceleration).all()


@pytest.fixture
def begin(runs: Runs):
    def begun(*overrides: str, device: str = "lever", intervene: str = "lever", **asked: object) -> Episode:
        runtime = runs.start(
            POLICY.format(intervene), "contract.max_duration_s=100", *overrides, mode="policy", **asked
        )
        runs.parts.Scene.success = lambda scene: False
        episode = Episode(runtime, runs.parts.MADE[device], runtime.session.bus.subscribe("/commander", 1000))
        episode.ticks(5)
        return episode

    return begun


def test_a_button_takes_the_robot_and_gives_it_back(begin) -> None:
    episode = begin()
    assert episode.moves()
    episode.press()
    episode.labels.drain()
    labels = episode.ticks(40)
    assert labels[:2] == ["policy", "handover"], "the command of the tick of the press is still the policy's"
    assert set(labels[1:]) == {"handover"}
    assert not episode.moves(), "nobody commands before the deadman is pressed"
    episode.device.press()
    episode.device.velocity = 0.2
    assert episode.ticks(20)[-1] == "operator"
    assert episode.moves()
    episode.device.pressed = False
    episode.ticks(20)
    assert not episode.moves()
    assert episode.ticks(1) == ["operator"], "who has the robot may let it stand"
    episode.press()
    labels = episode.ticks(40)
    assert labels[1] == "handover"
    assert labels[-1] == "policy"
    assert episode.moves()
    episode.check_steps()


def test_the_operator_takes_over_at_the_present_pose(begin) -> None:
    episode = begin()
    episode.moves()
    episode.press()
    episode.ticks(40)
    held = episode.commands[-1]
    episode.device.press()
    episode.ticks(30)
    np.testing.assert_allclose(episode.commands[-1], held, atol=0.02)  # the device starts at the measured positions
    episode.check_steps()


def test_the_policys_plan_is_dropped_and_requested_again(begin) -> None:
    episode = begin()
    stats = episode.run.session.acting.dispatch
    episode.ticks(10)
    assert stats.plan_length > 0
    episode.press()
    episode.ticks(2)
    assert stats.plan_length == 0
    requests = stats.requests
    episode.ticks(50)
    assert stats.requests == requests, "none while the operator has the robot"
    episode.press()
    episode.ticks(30)
    assert stats.requests > requests
    assert stats.holds == 0


def test_the_deadman_takes_the_robot_if_chosen(begin) -> None:
    episode = begin("episodes={takeover: deadman}")
    episode.device.press()
    assert episode.ticks(30)[-1] == "operator"
    episode.device.pressed = False
    assert episode.ticks(40)[-1] == "policy"
    episode.check_steps()


def test_a_key_takes_the_robot(begin) -> None:
    typed: list[queue.SimpleQueue[str]] = []

    def keys() -> queue.SimpleQueue[str]:
        typed.append(queue.SimpleQueue())
        return typed[-1]

    episode = begin("episodes={takeover_key: x}", keys=keys)
    for each in typed:
        each.put("x")
    assert episode.ticks(3)[-1] == "handover"
    assert episode.run.session.command_source.help().startswith("x  give the robot back")


def test_repeats_of_a_held_key_are_no_presses(begin) -> None:
    """A held key repeats after 0.4 s, every 40 ms; the terminal reports no releases."""
    typed: list[queue.SimpleQueue[str]] = []

    def keys() -> queue.SimpleQueue[str]:
        typed.append(queue.SimpleQueue())
        return typed[-1]

    def hold(ticks: int) -> list[str]:
        labels = []
        for tick in range(ticks):
            if tick == 0 or (tick >= 20 and tick % 2 == 0):
                for each in typed:
                    each.put("x")
            labels += episode.ticks(1)
        return labels + episode.ticks(30)

    episode = begin("episodes={takeover_key: x}", keys=keys)
    assert episode.ticks(5)[-1] == "policy"
    assert set(hold(60)[2:]) == {"handover"}, "taken at once, and not given back"
    assert list(dict.fromkeys(hold(60))) == ["handover", "policy"], "given back, and not taken again"
    assert set(hold(1)[2:]) == {"handover"}


def test_without_key_and_button_the_log_says_what_takes_the_robot(begin, caplog: pytest.LogCaptureFixture) -> None:
    begin()
    assert "and a button of lever (lever), only the service /intervene takes the robot" in caplog.text
    caplog.clear()
    begin("episodes={takeover: deadman}")
    assert "only the service" not in caplog.text


def test_the_service_takes_the_robot_for_other_front_ends(begin) -> None:
    episode = begin()
    call = episode.run.session.bus.call
    assert call("/intervene", True) == "handover"
    assert call("/intervene", True) == "handover"
    assert set(episode.ticks(20)[1:]) == {"handover"}
    call("/intervene", False)
    assert episode.ticks(40)[-1] == "policy"
    call("/intervene", None)
    assert episode.ticks(3)[-1] == "handover"
    with pytest.raises(RequestError, match="/intervene: take: expected true or false, got 'yes'"):
        call("/intervene", "yes")


def test_joints_without_a_device_hold(begin) -> None:
    episode = begin(intervene="{arm: lever}")
    episode.press()
    episode.ticks(40)
    episode.device.press()
    episode.device.velocity = 0.2
    before = episode.commands[-1]
    episode.ticks(40)
    pan, grip = np.abs(episode.commands[-1] - before)
    assert pan > 0.05
    assert grip == 0.0


def test_a_device_with_motors_is_driven_to_the_robot_first(begin, monkeypatch: pytest.MonkeyPatch) -> None:
    episode = begin()
    poses: list[Vector] = []

    def approach(measured) -> bool:
        poses.append(measured.position)
        return len(poses) == 25

    monkeypatch.setattr(episode.device, "approach", approach)
    episode.press()
    episode.ticks(5)
    episode.device.press()
    episode.ticks(20)
    assert set(episode.ticks(10)) == {"handover"}
    episode.ticks(10)
    assert len(poses) == 25
    assert not episode.device.pressed, "it is activated once it has arrived"
    episode.device.press()
    assert episode.ticks(3)[-1] == "operator"


def test_a_lost_device_is_a_fault_and_a_reset_gives_the_policy_the_robot(
    begin, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = begin()

    def gone(measured: object) -> object:
        raise TeleopError("unplugged")

    with monkeypatch.context() as patched:
        patched.setattr(episode.device, "read", gone)
        episode.ticks(30)
    assert episode.run.session.faults == ("unplugged",)
    assert not episode.moves()
    episode.run.reset()
    assert not episode.moves()
    episode.run.switch_mode("policy")
    assert episode.moves()
    assert episode.ticks(1) == ["policy"]


def test_a_mode_shares_its_device_with_the_mode_of_demonstrations(begin, runs: Runs) -> None:
    episode = begin(device="stick", intervene="stick", by_operator=True)
    connected = [call for call in runs.parts.CALLS if call.endswith("connect stick")]
    episode.run.switch_mode("teleop")
    episode.ticks(30)
    assert episode.moves()
    episode.run.switch_mode("policy")
    episode.ticks(5)
    assert [call for call in runs.parts.CALLS if call.endswith("connect stick")] == connected
    assert episode.run.session.commander == "policy"


def test_panel_and_summary_say_who_commands(begin) -> None:
    episode = begin()
    assert episode.run.session.commander == "policy"
    episode.press()
    episode.ticks(30)
    episode.device.press()
    episode.ticks(50)
    assert episode.run.session.commander == "operator"
    episode.run.session.bus.call("/intervene", False)
    assert episode.run.summary()["takeovers"] == 1
    assert episode.run.plan.mode.source.summary_rows()[0][1].startswith("1; the operator commanded for 1.0 s")


@pytest.mark.parametrize("seed", range(3))
def test_random_takeovers_stay_within_the_limits_and_are_labelled_as_they_happened(begin, seed: int) -> None:
    episode, rng = begin(), random.Random(seed)
    for _ in range(12):
        taken = 0
        episode.press()
        labels = episode.ticks(rng.randint(1, 20))
        assert labels[1:] == ["handover"] * (len(labels) - 1)
        episode.ticks(40)
        for _ in range(rng.randint(0, 3)):
            episode.device.press()
            episode.device.velocity = rng.uniform(-1.5, 1.5)
            labels = episode.ticks(rng.randint(2, 20))
            taken += 1
            assert labels[1:] == ["operator"] * (len(labels) - 1)
            episode.device.pressed = False
            assert set(episode.ticks(rng.randint(1, 10))) == {"operator"}
        episode.press()
        labels = episode.ticks(rng.randint(40, 60))
        assert labels[0] == ("operator" if taken else "handover")
        turn = labels.index("policy")
        assert labels[1:turn] == ["handover"] * (turn - 1)
        assert set(labels[turn:]) == {"policy"}
    episode.check_steps()
    assert episode.run.session.bus.dropped() == {}


class Notes:
    """Episodes that a recorder was given: outcome, and time of receipt and word of who commanded."""

    def __init__(self, recorder: object, monkeypatch: pytest.MonkeyPatch) -> None:
        self.episodes: list[list[tuple[int, str]]] = []
        self.outcomes: list[str] = []
        self.starts: list[int] = []
        for name in ("begin", "write", "end"):
            monkeypatch.setattr(recorder, name, getattr(self, name))

    def begin(self, episode: EpisodeStart) -> None:
        self.episodes.append([])
        self.starts.append(episode.stamp_ns)

    def write(self, topic: str, message: object, received_ns: int) -> None:
        if topic == "/commander":
            self.episodes[-1].append((received_ns, message.data))  # type: ignore[attr-defined]

    def end(self, episode: EpisodeEnd) -> None:
        self.outcomes.append(episode.outcome)


PARTS = "recording={type: lines, root: kept}"


def test_only_corrections_are_recorded_with_the_time_around_them(
    begin, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = begin(PARTS, "episodes={keep: corrections, before: 0.4, after: 0.2}")
    notes = Notes(runs.parts.MADE["recording"], monkeypatch)
    for _ in range(2):
        episode.ticks(50)
        episode.press()
        episode.ticks(40)
        episode.device.press()
        episode.ticks(20)
        episode.press()
        episode.ticks(60)
    assert notes.outcomes == ["unknown", "unknown"]
    for start, labels in zip(notes.starts, notes.episodes, strict=True):
        times, words = [each for each, _ in labels], [word for _, word in labels]
        assert times == sorted(times)
        turn, back = words.index("handover"), len(words) - words[::-1].index("handover") - 1
        assert start == times[0]
        assert (times[turn] - start) / 1e9 == pytest.approx(0.4, abs=0.021)
        assert (times[-1] - times[back + 1]) / 1e9 == pytest.approx(0.2, abs=0.021)
        assert list(dict.fromkeys(words)) == ["policy", "handover", "operator"]


def test_the_end_of_an_episode_ends_its_correction_with_the_outcome(
    begin, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    episode = begin(PARTS, "episodes={keep: corrections}")
    notes = Notes(runs.parts.MADE["recording"], monkeypatch)
    episode.ticks(20)
    episode.press()
    episode.ticks(30)
    runs.parts.Scene.success = lambda scene: True
    episode.ticks(3)
    assert notes.outcomes == ["success"]


def test_highlights_are_recorded_from_before_a_key(begin, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    episode = begin(PARTS, "episodes={keep: highlights, before: 0.5}")
    notes = Notes(runs.parts.MADE["recording"], monkeypatch)
    call = episode.run.session.bus.call
    episode.ticks(60)
    assert notes.episodes == []
    now_ns = episode.run.session.clock.now_ns()
    call("/record_episode/highlight", None)
    episode.ticks(30)
    call("/record_episode/highlight", None)
    episode.ticks(30)
    assert (now_ns - notes.starts[0]) / 1e9 == pytest.approx(0.5, abs=0.041)
    assert (notes.episodes[0][-1][0] - now_ns) / 1e9 == pytest.approx(0.6, abs=0.041)
    assert notes.outcomes == ["unknown"]
    assert len(notes.episodes) == 1
