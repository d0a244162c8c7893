"""Random interleavings of requests, each delivered later than it was made: what a person stopped stays stopped.

Some arrive while the run starts and moves to its startup pose, and while it ends and moves to its stop pose.

IBROBOT_INTERLEAVINGS sets their number; each is one seed, which a failure names.
"""

from __future__ import annotations

import os
import random
from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, override

import attrs
import numpy as np
import pytest
from ibrobot_testing.fakes import FakeTeleop

from ibrobot_core.api import (
    NS_PER_S,
    Deadman,
    FollowTrajectory,
    Header,
    IbrobotError,
    JointReading,
    JointTrajectory,
    JointTrajectoryPoint,
    TeleopCommand,
    TeleopDescriptor,
    ns,
)
from ibrobot_core.app import ComponentFailed, ControlState, Registry
from ibrobot_core.interfaces.run_state import PlanRecord

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime

INTERLEAVINGS = int(os.environ.get("IBROBOT_INTERLEAVINGS", "240"))
PARTS = 8
ACTIONS, GAP_TICKS, DELAY_TICKS = 14, 8, 15
"""Actions of an interleaving, and the longest times between two of them and until the delivery of one."""
SETTLES_TICKS = 30
"""In this time after a mode switch or a reset on the move, the arm brakes and returns to where it was measured."""
BEGINS_RAD, STILL_RAD = 1e-3, 1e-9
MODES = ("policy", "teleop", "plan")


class Lever(FakeTeleop):
    """A lever that is pushed all the time, and moves the robot while its deadman allows it."""

    held = False
    """Whether a hand holds the deadman of all levers."""
    allowed_ns = -NS_PER_S
    """When one of them last moved the robot [ns]."""

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        self.pressed, self.velocity = Lever.held, 0.3
        command = super().read(measured)
        if command.positions is not None:
            Lever.allowed_ns = measured.stamp_ns
        return command


@pytest.fixture
def levers(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lever, "held", False)
    monkeypatch.setattr(Lever, "allowed_ns", -NS_PER_S)
    lever = TeleopDescriptor("lever", lambda _, ctx: Lever(ctx), "a lever with the deadman of core")
    real = Registry.find

    def find(registry: Registry, kind: str, name: str) -> object:
        return lever if (kind, name) == ("teleop", "lever") else real(registry, kind, name)

    monkeypatch.setattr(Registry, "find", find)


@attrs.define(eq=False)
class Story:
    """One interleaving: makes requests, delivers them in any order, and watches every command."""

    run: Runtime
    draw: random.Random
    told: list[str] = attrs.field(factory=list)
    seen: Counter[str] = attrs.field(factory=Counter)
    tick: int = 0
    waiting: list[tuple[int, Callable[[], object]]] = attrs.field(factory=list)
    latched: bool = False
    """Whether a stop was delivered, and no reset that saw it."""
    consent: bool = True
    """Whether somebody has asked for motion since the last stop, or change of who commands."""
    settles: int = SETTLES_TICKS
    begins: bool = False
    """Whether the next command must be where the joints are."""
    before: ControlState | None = None
    step: Any = None

    def note(self, what: str) -> None:
        self.told.append(f"{self.tick}: {what}")

    def later(self, name: str, act: Callable[[], object]) -> None:
        """Deliver a request that is made now."""
        self.note(f"made {name}")
        self.waiting.append((self.tick + self.draw.randrange(DELAY_TICKS), lambda: self.deliver(name, act)))

    def deliver(self, name: str, act: Callable[[], object]) -> None:
        stopped, number = self.latched, self.run.session.stops
        try:
            act()
        except IbrobotError as error:
            self.note(f"refused {name}: {error}")
            self.seen[f"{name}, refused"] += 1
        else:
            self.note(f"delivered {name}")
            self.seen[name] += 1
            if stopped and name not in ("stop", "reset"):
                assert self.latched
        assert name == "stop" or self.run.session.stops == number

    def stop(self) -> None:
        self.latched, self.consent = True, False
        self.run.session.emergency_stop()

    def reset(self, stops: int) -> None:
        at_rest = self.run.session.control._core._safety.at_rest  # type: ignore[attr-defined]
        self.run.session.bus.call("/reset", {"stops": stops})
        assert stops == self.run.session.stops, "it knew of every stop"
        self.begins, self.settles = at_rest, 0 if at_rest else SETTLES_TICKS
        self.latched, Lever.allowed_ns = False, -NS_PER_S
        if self.run.session.mode != "policy" or self.run.session.held:
            self.consent = False

    def switch(self, mode: str, stops: int) -> None:
        known = self.run.session.mode, self.run.session.held
        self.run.session.bus.call("/set_mode", {"mode": mode, "stops": stops})
        assert not self.latched
        if known != (self.run.session.mode, self.run.session.held):
            self.consent, self.settles, Lever.allowed_ns = mode == "policy", SETTLES_TICKS, -NS_PER_S

    def goal(self, stops: int) -> None:
        point = JointTrajectoryPoint(600_000_000, np.array([self.draw.uniform(-0.8, 0.8)]))
        goal = FollowTrajectory(JointTrajectory(Header(0, ""), ("pan",), (point,)))
        self.run.session.send_goal("arm_trajectory", "1", goal, stops)
        assert not self.latched
        self.consent = True

    def plan(self, generation: int) -> None:
        ends = np.array([[self.draw.uniform(-0.8, 0.8)] * 2])
        now_ns = self.run.session.clock.now_ns()
        current = generation == self.run.session.generation
        self.run.session.control.write_plan(PlanRecord(generation, now_ns, 1, np.ones(2, dtype=bool), ends))
        if current and not self.latched and self.run.session.mode in ("policy", "teleop"):
            self.consent = True

    def intervene(self) -> None:
        known = bool(self.run.session.faults)
        self.run.session.bus.call("/intervene", None)
        assert not known

    def episode(self) -> None:
        episodes = self.run.session.episodes
        episodes.end("unknown") if episodes.running else episodes.begin()

    def start(self) -> bool:
        """Start, with requests meanwhile; return whether the run goes on."""
        self.meanwhile(self.run.start)
        return not self.run.session.finished.is_set()

    def end(self) -> None:
        """End the run, with requests meanwhile."""
        assert self.before is not None
        self.meanwhile(self.run.stop)

    def meanwhile(self, act: Callable[[], object]) -> None:
        """Let the robot start or end, which moves it to a pose, with requests at each of its states."""
        hooks = self.run.session.on_state
        hooks.append(self.state_on_the_way)
        try:
            act()
        except ComponentFailed as error:
            assert self.latched, error  # noqa: PT017 - a start fails after a stop
            self.run.session.finish()
        finally:
            if self.state_on_the_way in hooks:
                hooks.remove(self.state_on_the_way)

    def state_on_the_way(self, state: ControlState) -> None:
        self.tick += 1
        self.check_limits(state)
        if self.latched:
            self.seen["braking on the way"] += int(np.abs(self.step).max() > STILL_RAD)
        else:
            self.seen["moves on the way"] += int(np.abs(self.step).max() > STILL_RAD)
        if self.draw.random() < 0.1:
            self.act()
        self.deliver_due()

    def check_limits(self, state: ControlState) -> None:
        """Check a command by those before: it begins where the joints are, is smooth, and brakes after a stop."""
        robot = self.run.session.config.robot
        period = 1 / self.run.session.config.control.rate_hz
        assert state.estop == self.latched
        if self.before is None:
            self.before, self.step = state, state.command - state.position
            assert np.abs(self.step).max() <= BEGINS_RAD + (robot.max_acceleration * period**2).max()
            return
        step = state.command - self.before.command
        assert np.abs(step - self.step).max() <= (robot.max_acceleration * period**2).max() * 1.001
        assert np.abs(step).max() <= (robot.max_velocity * period).max() * 1.001
        assert not self.latched or (np.abs(step) <= np.abs(self.step) + STILL_RAD).all(), "it speeds up while stopped"
        self.before, self.step = state, step

    def act(self) -> None:
        """Make one request."""
        session = self.run.session
        stops, generation, mode = session.stops, session.generation, self.draw.choice(MODES)
        requests = {
            "stop": self.stop,
            "reset": lambda: self.reset(stops),
            "mode": lambda: self.switch(mode, stops),
            "goal": lambda: self.goal(stops),
            "plan": lambda: self.plan(generation),
            "intervene": self.intervene,
        }
        if self.run.session.bus.serves("/reset"):  # neither at the start nor at the end
            requests["episode"] = self.episode
        name = self.draw.choice([*requests, "intervene", "stop", "reset", "reset", "deadman", "deadman"])
        if name == "deadman":
            Lever.held = not Lever.held
            self.note(f"deadman {'pressed' if Lever.held else 'released'}")
        elif name == "stop" and self.draw.random() < 0.5:
            self.deliver(name, self.stop)
        else:
            self.later(name, requests[name])

    def play(self) -> None:
        self.ticks(3)
        for _ in range(ACTIONS):
            self.act()
            self.ticks(self.draw.randrange(GAP_TICKS))
        self.ticks(DELAY_TICKS + SETTLES_TICKS)

    def ticks(self, count: int) -> None:
        for _ in range(count):
            self.tick += 1
            self.deliver_due()
            generation = self.run.session.generation
            assert not self.run.step(), self.run.session.failure_text
            self.watch(scene=self.run.session.generation != generation)

    def deliver_due(self) -> None:
        """Deliver what is due, in any order."""
        due = [each for each in self.waiting if each[0] <= self.tick]
        self.draw.shuffle(due)
        for each in due:
            self.waiting.remove(each)
            each[1]()

    def watch(self, *, scene: bool) -> None:
        """Check the newest command."""
        state, robot = self.run.session.state, self.run.session.config.robot
        assert state is not None
        assert state.estop == self.latched
        period = 1 / self.run.session.config.control.rate_hz
        if scene:  # an episode was set up within the step: its commands begin anew at the next tick
            assert not self.latched
            self.begins, self.before, self.step = True, state, np.zeros(len(state.command))
            return
        if self.begins or self.before is None:
            if self.begins:
                # What was commanded since the reset, in the same tick, has accelerated for one period.
                away = (robot.max_acceleration * period**2).max() * 1.001 if self.consent else BEGINS_RAD
                assert np.abs(state.command - state.position).max() <= away
                self.seen["begun"] += 1
            self.step = state.command - (state.position if self.begins else state.command)
            self.begins = False
        else:
            step = state.command - self.before.command
            faster = np.abs(step) > np.abs(self.step) + STILL_RAD
            change = np.abs(step - self.step).max()
            assert change <= (robot.max_acceleration * period**2).max() * 1.001
            assert np.abs(step).max() <= (robot.max_velocity * period).max() * 1.001
            if self.latched:
                assert not faster.any(), "it speeds up while it is stopped"
                self.seen["braking"] += int(np.abs(step).max() > STILL_RAD)
            elif not self.settles and not self.consent and faster.any():
                assert self.run.session.mode in ("teleop", "policy"), "nobody asked for this motion"
                assert state.stamp_ns - Lever.allowed_ns <= ns(Deadman.hold_s), "no deadman allows this motion"
                self.seen["by deadman"] += 1
            else:
                self.seen["moves"] += int(faster.any())
            self.step = step
        self.settles = max(0, self.settles - 1)
        self.before = state


@pytest.mark.parametrize("part", [0, 1, *(pytest.param(part, marks=pytest.mark.long) for part in range(2, PARTS))])
def test_nothing_moves_after_a_stop_until_a_later_reset(runs: Runs, levers: None, part: int) -> None:
    seen: Counter[str] = Counter()
    for seed in range(part, INTERLEAVINGS, PARTS):
        draw = random.Random(seed)
        run = runs.make(
            "control_modes.policy.inference={model: net, intervene: lever}",
            "control_modes.teleop.teleop=lever",
            f"control.startup={draw.choice(('hold', 'pose up'))}",
            f"control.stop={draw.choice(('hold', 'pose up'))}",
            mode=draw.choice(MODES),
        )
        runs.made.clear()
        story = Story(run, draw, seen=seen, consent=run.session.mode == "policy")
        try:
            if story.start():
                story.play()
                story.end()
        except AssertionError as error:
            raise AssertionError(f"seed {seed}: {error}\n" + "\n".join(story.told)) from error
        finally:
            run.stop()
    if os.environ.get("IBROBOT_INTERLEAVINGS"):
        print(dict(seen))
    wanted = {
        "stop", "reset", "reset, refused", "mode", "mode, refused", "goal, refused", "plan", "episode", "intervene",
        "begun", "braking", "moves", "braking on the way", "moves on the way",
    }  # fmt: skip
    assert wanted <= set(seen), f"not every kind of request came about: {wanted - set(seen)}"
