"""Runs of a made policy on a made arm, with a fault planted in each: what an episode's messages would be."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.api import (
    MODEL_ANSWERS,
    ActionPart,
    Contract,
    EpisodeEnd,
    EpisodeReader,
    EpisodeStart,
    EpisodeSummary,
    Feature,
    Float64MultiArray,
    Header,
    Image,
    JointState,
    Message,
    ModelAnswer,
    ObservationPart,
    Recorded,
    String,
    TopicSummary,
)
from ibrobot_core.app import Align
from ibrobot_core.schema import ImageSpec

START_NS = 1_700_000_000_000_000_000
JOINTS = ("pan", "lift", "elbow", "gripper")
HZ, CONTROL_HZ = 30, 100
STEP_NS = round(1e9 / HZ)
CAMERAS = ("top", "wrist")
SIZE = (72, 96)
HOME = np.array([0.0, -0.8, 0.9, 0.2])
REACH = np.array([0.7, 0.3, -0.4, 0.9])
COMMANDS, STATES, COMMANDER, GUARD = "/arm/commands", "/joint_states", "/commander", "/guard"


def contract(cameras: Collection[str] = CAMERAS) -> Contract:
    """Four joints and cameras at 30 Hz."""
    return Contract(
        float(HZ),
        (
            ObservationPart(
                "observation.state", STATES, JointState.ros_type, tuple(f"position.{j}" for j in JOINTS), None,
                Align(), Feature("float32", (len(JOINTS),), tuple(f"{j}.pos" for j in JOINTS)),
            ),
            *(
                ObservationPart(
                    f"observation.images.{camera}", f"/{camera}", Image.ros_type, (), ImageSpec(),
                    Align("asof", tol_ms=500.0), Feature("image", (*SIZE, 3), ("height", "width", "channels")),
                )
                for camera in cameras
            ),
        ),
        (ActionPart("arm", COMMANDS, Float64MultiArray.ros_type, "hold", JOINTS),),
    )  # fmt: skip


_STILL = (0.0, 0.0, 0.0)


APART = '{"first": "gripper", "second": "bin", "distance": 0.0031, "text": "gripper was 3.1 mm from bin"}'
"""What the guard says."""


@attrs.frozen(kw_only=True)
class Run:
    """How a run goes; by default well."""

    seed: int = 0
    seconds: float = 8.0
    chunk: int = 40
    latency_s: float = 0.06
    watermark: int = 20
    failing: float = 0.0
    """Share of the requests that fail."""
    velocity: float = 4.0
    lag_s: float = 0.05
    gain: Mapping[int, float] = attrs.field(factory=dict)
    """Joint -> share of its command that it follows."""
    slack: Mapping[int, float] = attrs.field(factory=dict)
    """Joint -> play [rad]."""
    state_age_s: float = 0.002
    picture_age_s: float = 0.03
    pause: tuple[float, float] = (0.0, 0.0)
    """Period and length of pauses of the control loop [s]."""
    torn: float = 0.0
    """How far the intentions of successive answers are apart [rad]."""
    idle_s: float = 0.3
    """Time before the policy moves."""
    speed: float = 1.0
    noise: float = 0.004
    guarded: tuple[float, float] = (0.0, 0.0)
    """Shares of the run from which and until which the guard holds the arm back."""
    takeover: tuple[float, float] = (0.0, 0.0)
    """From when to when an operator commands, as shares of the run."""
    cameras: tuple[str, ...] = CAMERAS
    picture: Callable[[str, np.ndarray[Any, Any], float], np.ndarray[Any, Any]] = lambda camera, picture, t_s: picture
    """What becomes of a camera's picture."""
    moved: Mapping[str, tuple[float, float, float]] = attrs.field(factory=dict)
    """Camera -> by how much it has moved [pixels] and turned [rad]."""
    exchanged: bool = False
    """Whether the cameras have each other's place."""
    camera_hz: float = 10.0
    seen: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]] = lambda state: state
    """What the robot reports of its joints."""
    answered: Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]] = lambda chunk: chunk
    """What the model makes of the right actions."""
    zero: Mapping[int, float] = attrs.field(factory=dict)
    """Joint -> by how much its reported position is above the true one, which cameras see [rad]."""
    start: tuple[float, ...] = (0.0,) * 4
    """Where the arm begins, from its usual start."""
    drift: float = 0.0
    outcome: str = "success"
    prompt: str = "pick up the cube"
    amplitude: float = 1.0
    stall: tuple[float, float] = (0.0, 0.0)
    """When a person who demonstrates stops, and for how long [s]."""
    shake: float = 0.0
    """How far the hand of a person who demonstrates trembles [rad]."""
    cut: tuple[int, float] = (0, np.inf)
    """A joint, and the position beyond which its leader does not go [rad]."""
    shut: bool = False
    """Whether the gripper does not act."""
    blind: tuple[float, float] = (0.0, 0.0)
    """From when to when no picture comes [s]."""
    acts: bool = True
    """Whether a model acts; otherwise a person demonstrates."""


def intended(run: Run, t_s: np.ndarray[Any, Any], phase: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """What a good policy commands at a time of the run [rad], shape (N, J): out, grasp, back."""
    at = np.clip((np.asarray(t_s) - run.idle_s) * run.speed, 0.0, None)
    period = 6.0
    s = 0.5 - 0.5 * np.cos(2 * np.pi * np.minimum(at, period) / period)
    path = HOME + run.amplitude * REACH * s[:, None]
    path[:, 0] += 0.25 * phase[0] * s
    path[:, 1] += 0.15 * phase[1] * s**2
    path[:, 3] = HOME[3] + 0.9 * (0.5 - 0.5 * np.tanh(4 * (at - 0.42 * period)))
    fading = np.exp(-at / 0.6)[:, None]
    return path + fading * (np.array(run.start) + 0.03 * phase[2:6])


class Made(EpisodeReader):
    """The messages of a run."""

    def __init__(self, run: Run, name: str = "made") -> None:
        self.run, self._name = run, name
        self._messages = list(_Maker(run).messages())

    @override
    def summary(self) -> EpisodeSummary:
        counts: dict[str, TopicSummary] = {}
        for item in self._messages:
            had = counts.get(item.topic)
            counts[item.topic] = TopicSummary(item.message.ros_type, 1 + (had.count if had else 0))
        begin, end = self._messages[0].received_ns, self._messages[-1].received_ns
        return EpisodeSummary(Path(self._name), True, begin, end, counts, metadata(self.run), self.run.outcome)

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        return (item for item in self._messages if topics is None or item.topic in topics)

    @override
    def digest(self) -> str:
        return self._name

    @override
    def close(self) -> None:
        pass


def metadata(run: Run) -> dict[str, str]:
    """What the recorder would have written."""
    made = contract(run.cameras)
    limits = {"lower": -3.0, "upper": 3.0, "max_velocity": run.velocity, "max_acceleration": 40.0}
    document = {
        "robot": {"name": "made", "joints": [{"name": joint, **limits} for joint in JOINTS]},
        "control": {"guard": {"type": "clearance"}} if run.guarded[1] else {},
        "control_modes": {
            "learned": {"inference": {"model": "act"}, "dispatch": {"watermark": run.watermark}},
            "teleop": {"teleop": "leader"},
        },
    }
    policy = {
        "model": "act",
        "type": "lerobot",
        "fingerprint": "f" * 8,
        "weights": "w" * 8,
        "execution_mode": "monolithic",
    }
    return {
        "contract": json.dumps(made.canonical()), "fingerprint": made.fingerprint(), "config": json.dumps(document),
        "mode": "learned" if run.acts else "teleop", "prompt": run.prompt, "robot": "made",
        **({"policy": json.dumps(policy)} if run.acts else {}),
    }  # fmt: skip


def record_run(folder: Path, run: Run) -> Path:
    """Record a run as a bag, which needs ibrobot-plugin-mcap."""
    from ibrobot_testing.contexts import host_context

    from ibrobot_core.app import installed_plugins

    descriptor = installed_plugins().find("recorder", "mcap")
    made = Made(run)
    summary = made.summary()
    recorder = descriptor.make(descriptor.options(), host_context())
    topics = {topic: each.type for topic, each in summary.topics.items()}
    folder.parent.mkdir(parents=True, exist_ok=True)
    recorder.begin(EpisodeStart(folder, summary.start_ns, topics, metadata(run)))
    for item in made.messages():
        recorder.write(item.topic, item.message, item.received_ns)
    recorder.end(EpisodeEnd(summary.end_ns, run.outcome, {}))
    recorder.close()
    return folder


class _Maker:
    """Makes the messages of a run, tick by tick."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._rng = np.random.default_rng(run.seed)
        self._phase = self._rng.uniform(-1, 1, 8)
        self._chunks: list[tuple[int, int, np.ndarray[Any, Any], int]] = []
        """Step observed, tick of arrival, actions and number of each request."""
        self._plan, self._counts, self._begin = np.empty((0, len(JOINTS))), np.empty(0), 0
        self._command = intended(run, np.zeros(1), self._phase)[0]
        self._state = self._command.copy()
        t_s, (begin, lasts) = np.arange(int(run.seconds * CONTROL_HZ)) / CONTROL_HZ, run.stall
        at = np.where(t_s < begin, t_s, np.maximum(begin, t_s - lasts)) if lasts else t_s
        self._demonstration = np.empty(0) if run.acts else intended(run, at, self._phase)
        self._held = False
        self._waiting, self._side, self._next_ask, self._paused_until = False, 1.0, 0.0, 0.0

    def messages(self) -> Iterator[Recorded]:
        for tick in range(int(self.run.seconds * CONTROL_HZ)):
            t_s = tick / CONTROL_HZ
            for topic, message in (*self._model(tick, t_s), *self._control(tick, t_s), *self._look(tick, t_s)):
                t_ns = START_NS + round(t_s * 1e9)
                yield Recorded(topic, message, t_ns, t_ns)

    def _model(self, tick: int, t_s: float) -> Iterator[tuple[str, Message]]:
        run, step = self.run, int(t_s * HZ)
        remaining = self._begin + len(self._plan) - step - 1
        if run.acts and not self._waiting and remaining <= run.watermark and t_s >= self._next_ask and tick % 3 == 0:
            self._ask(tick, step)
        for observed, arrives, actions, number in self._chunks:
            if arrives != tick:
                continue
            self._waiting = False
            failed = self._rng.uniform() < run.failing
            outcome = "failed" if failed else "used" if step - observed < len(actions) else "late"
            latency_ms = (t_s - observed / HZ) * 1e3
            self._next_ask = t_s + (0.3 if failed else 0.0)
            if outcome == "used":
                self._plan, self._counts, self._begin = _blend(
                    self._plan, self._counts, self._begin, actions, observed, step
                )
            yield (
                MODEL_ANSWERS,
                ModelAnswer(
                    Header(START_NS + round(t_s * 1e9)), number, START_NS + observed * STEP_NS, "act", "", "w" * 8,
                    run.prompt, outcome, "RuntimeError: out of memory" if failed else "", latency_ms, latency_ms, 0.0,
                    STEP_NS, JOINTS, np.empty(0) if failed else actions.ravel(),
                ),
            )  # fmt: skip

    def _ask(self, tick: int, step: int) -> None:
        run, rng = self.run, self._rng
        self._waiting = True
        actions = intended(run, (step + np.arange(run.chunk)) / HZ, self._phase)
        actions += (run.noise + run.drift) * rng.normal(0, 1, (1, len(JOINTS)))
        actions[:, 0] += self._side * run.torn / 2
        actions[:, 1] += self._side * run.torn / 3
        self._side = -self._side
        latency = run.latency_s * float(rng.uniform(0.85, 1.2))
        number = len(self._chunks) + 1
        self._chunks.append((step, tick + max(1, round(latency * CONTROL_HZ)), run.answered(actions), number))

    def _control(self, tick: int, t_s: float) -> Iterator[tuple[str, Message]]:
        run = self.run
        operated = run.takeover[0] * run.seconds <= t_s < run.takeover[1] * run.seconds
        held = run.guarded[0] * run.seconds <= t_s < run.guarded[1] * run.seconds
        if held != self._held:
            yield GUARD, String(APART if held else "")
        self._held = held
        if run.pause[0] and t_s >= self._paused_until and tick and tick % int(run.pause[0] * CONTROL_HZ) == 0:
            self._paused_until = t_s + run.pause[1]
        if t_s >= self._paused_until:
            most = 0.0 if self._held else run.velocity / CONTROL_HZ
            self._command = self._command + np.clip(self._wanted(t_s, operated) - self._command, -most, most)
            yield COMMANDS, Float64MultiArray(self._command.copy())
        target = self._command.copy()
        for j, gain in run.gain.items():
            target[j] = HOME[j] + gain * (self._command[j] - HOME[j])
        for j, play in run.slack.items():
            target[j] = float(np.clip(self._state[j], self._command[j] - play, self._command[j] + play))
        self._state = self._state + (target - self._state) * min(1.0, 1 / CONTROL_HZ / max(run.lag_s, 0.01))
        if t_s < self._paused_until:
            return
        reported = run.seen(self._state + self._rng.normal(0, 0.001, len(JOINTS)))
        yield STATES, JointState(Header(START_NS + round((t_s - run.state_age_s) * 1e9)), JOINTS, reported)
        if run.takeover[1]:
            yield COMMANDER, String("operator" if operated else "policy")

    def _wanted(self, t_s: float, operated: bool) -> np.ndarray[Any, Any]:
        if operated:
            return HOME + 0.3 * np.sin(t_s)
        if not self.run.acts:
            return self._demonstrated(t_s)
        i = int(t_s * HZ) - self._begin
        if not 0 <= i < len(self._plan):
            return self._command
        return self._plan[i] + (t_s * HZ % 1) * (self._plan[min(i + 1, len(self._plan) - 1)] - self._plan[i])

    def _demonstrated(self, t_s: float) -> np.ndarray[Any, Any]:
        run = self.run
        wanted = self._demonstration[round(t_s * CONTROL_HZ)].copy()
        wanted += run.shake * self._rng.normal(0, 1, len(JOINTS)) if run.shake else 0.0
        wanted[run.cut[0]] = min(wanted[run.cut[0]], run.cut[1])
        if run.shut:
            wanted[3] = HOME[3] + 0.9
        return wanted

    def _look(self, tick: int, t_s: float) -> Iterator[tuple[str, Message]]:
        run, every = self.run, CONTROL_HZ / self.run.camera_hz
        if (tick and int(tick / every) == int((tick - 1) / every)) or run.blind[0] <= t_s < run.blind[1]:
            return
        for camera in run.cameras:
            true = self._state.copy()
            for j, off in run.zero.items():
                true[j] -= off
            shown = run.picture(camera, draw(camera, true, run.seed, self._rng, run.moved.get(camera, _STILL)), t_s)
            header = Header(START_NS + round((t_s - run.picture_age_s) * 1e9))
            topic = f"/{run.cameras[run.cameras.index(camera) - 1] if run.exchanged else camera}"
            yield topic, Image(header, shown.shape[0], shown.shape[1], "rgb8", shown.shape[1] * 3, shown.ravel())


def _blend(plan: Any, counts: Any, begin: int, actions: Any, observed: int, step: int) -> tuple[Any, Any, int]:
    """The plan with a chunk, from the current step on, as the dispatcher blends it with its usual coefficient."""
    end = max(begin + len(plan), observed + len(actions))
    made, count = np.zeros((end - step, len(JOINTS))), np.zeros(end - step)
    for values, seen, first in ((plan, counts, begin), (actions, np.ones(len(actions)), observed)):
        for i in range(max(step, first), first + len(values)):
            at, row = i - step, values[i - first]
            if count[at]:
                weights = np.exp(-0.01 * np.arange(count[at] + 1))
                made[at] += (row - made[at]) * weights[-1] / weights.sum()
                count[at] += 1
            else:
                made[at], count[at] = row, seen[i - first]
    return made, count, step


_TEXTURES: dict[str, np.ndarray[Any, Any]] = {}


def texture(camera: str, margin: int = 24) -> np.ndarray[Any, Any]:
    """The scene before a camera, larger than its picture by a margin on each side."""
    if camera not in _TEXTURES:
        rng = np.random.default_rng(sum(map(ord, camera)))
        height, width = SIZE[0] + 2 * margin, SIZE[1] + 2 * margin
        scene = np.full((height, width, 3), (150.0, 130.0, 105.0) if camera == "top" else (95.0, 110.0, 125.0))
        rows, columns = np.mgrid[0:height, 0:width]
        scene += (0.3 * columns if camera == "top" else -0.25 * rows)[..., None]
        for _ in range(26):
            y, x, h, w = (int(each) for each in rng.integers(0, (height, width, 30, 34)))
            scene[y : y + h + 4, x : x + w + 4] = rng.uniform(20, 235, 3)
        _TEXTURES[camera] = scene.astype(np.float32)
    return _TEXTURES[camera]


@lru_cache
def _scene(camera: str, moved: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    """What a camera sees without the object and the arm."""
    scene = texture(camera)
    height, width = SIZE
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    y, x = rows - height / 2, columns - width / 2
    c, s = np.cos(moved[2]), np.sin(moved[2])
    at_y = np.clip(np.rint(24 + height / 2 + s * x + c * y + moved[1]), 0, scene.shape[0] - 1).astype(int)
    at_x = np.clip(np.rint(24 + width / 2 + c * x - s * y + moved[0]), 0, scene.shape[1] - 1).astype(int)
    return scene[at_y, at_x]


def draw(
    camera: str, state: Any, seed: int, rng: np.random.Generator, moved: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> np.ndarray[Any, Any]:
    """The picture of a camera: the scene, an object whose place the seed decides, and the arm.

    `moved`: by how much the camera has moved [pixels] and turned [rad].
    """
    picture = _scene(camera, moved).copy()
    height, width = SIZE
    place = np.random.default_rng(seed + 7).uniform(0.3, 0.7, 2)
    oy, ox = int(place[0] * height - moved[1]), int(place[1] * width - moved[0])
    picture[max(0, oy - 4) : oy + 4, max(0, ox - 4) : ox + 4] = (220, 30, 30)
    ay, ax = int(height * (0.5 - 0.3 * state[1]) - moved[1]), int(width * (0.5 + 0.35 * state[0]) - moved[0])
    picture[max(0, ay) : height, max(0, ax - 3) : ax + 4] = (40, 40, 45)
    picture += rng.normal(0, 2.5, picture.shape)
    return np.clip(picture, 0, 255).astype(np.uint8)


def window_of(run: Run, name: str = "made") -> Any:
    """The window of a run."""
    from ibrobot_diagnose.window import read_window

    return read_window(Made(run, name))
