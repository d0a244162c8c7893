"""Gymnasium environment: a run in lockstep that advances by one action per step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar, override

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ibrobot_core.api import Contract, Frame, HardwareError, Image, SteppedClock, Vector, ns
from ibrobot_core.app import (
    ControlMode,
    FrameSampler,
    LaunchRequest,
    Runtime,
    Session,
    SourceWorker,
    StreamingRun,
    Subscription,
    installed_plugins,
)
from ibrobot_gym.config import RENDERED, environment_config

STATE, SCENE, IMAGES = "observation.state", "observation.environment_state", "observation.images."
_RENDERED_TOPIC = f"/camera/{RENDERED}/image_raw"
_ALIGNED_NS = 1_000_000_000
"""Episodes begin at multiples of this time, so that the pictures of equal seeds are equal."""
_PATIENCE_S = 2.0
"""Time within which the first observations arrive."""

type Observation = dict[str, Any]


class EnvironmentSource(SourceWorker):
    """Takes the place of a policy: `frame` is the newest observation, `act` commands from its tick on."""

    session: StreamingRun
    autonomous = True

    def __init__(self, session: StreamingRun, mode: ControlMode) -> None:
        super().__init__(session, mode, "actions of an environment")
        self._contract = Contract.from_config(session.config)
        self._sampler: FrameSampler | None = None
        self.frame: Frame | None = None
        """The frame of the last tick; None before the first complete one of an episode."""

    @override
    def begin_mode(self, seed: int) -> None:
        self.frame = None
        self._next_ns = self.session.bus.snapshot_ns() + self._contract.step_ns
        self._sampler = FrameSampler(self._contract, self.session.bus)

    @override
    def end_mode(self) -> None:
        if self._sampler is not None:
            self._sampler.close()
            self._sampler = None

    @override
    def work(self, timeout_s: float) -> None:
        with self.lock:
            now_ns = self.session.bus.snapshot_ns()
            if self._sampler is None or now_ns < self._next_ns:
                return
            frame = self._sampler.sample(self._next_ns)
            self._next_ns += self._contract.step_ns
            if not frame.missing:
                self.frame = frame

    def act(self, action: Vector) -> None:
        """Command joint positions [rad], shape (A,), from the tick of the last frame on."""
        assert self.frame is not None
        self.session.send_plan(self.frame.stamp_ns, self._contract.step_ns, self._contract.action_joints, action[None])


class RobotEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A scene, stepped at the rate of the robot's contract.

    Each step is that of a run in lockstep: executors, safety layer and physics at the control rate, cameras, and the
    alignment of the contract. Actions are joint positions [rad], shape (A,). Observations have the
    keys that LeRobot's tools know: `agent_pos`, the state; `environment_state`, the scene's ground truth; `pixels`, the
    pictures by camera. An episode ends with success (reward 1, `info["is_success"]`), or is truncated after
    `contract.max_duration_s`, or by a fault for which the robot stops, e.g. of a joint that presses against something.
    `info["fault"]` has the fault; `reset` clears it.

    Args:
        config: a robot YAML, or the name of a shipped one.
        scene: the type of scene; None: that of the file.
        task: the task in words.
        cameras: cameras of the scene to observe, e.g. `("top", "wrist_cam")`, in addition to those of the file.
        image_size: height and width of their pictures [px].
        overrides: `path.to.key=value`, e.g. `simulation.scene.light=[0.5, 1.5]`.
        render_mode: `rgb_array`, or None.
        render_camera: the camera that `render` shows.

    Attributes:
        config: the checked robot YAML.

    Raises:
        ConfigError: for faults of the robot YAML.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 30}  # type: ignore[misc]

    def __init__(
        self,
        config: str = "so101_scenes",
        scene: str | None = None,
        task: str = "",
        cameras: Sequence[str] = (),
        image_size: tuple[int, int] = (240, 320),
        overrides: Sequence[str] = (),
        render_mode: str | None = None,
        render_camera: str = "front",
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode {render_mode!r} is not one of: rgb_array")
        self.render_mode = render_mode
        self.task = self.task_description = task
        rendered = render_camera if render_mode is not None else None
        self.config = environment_config(config, scene, cameras, image_size, rendered, overrides)
        self._contract = Contract.from_config(self.config)
        self.metadata = {**self.metadata, "render_fps": round(self.config.contract.rate_hz)}  # type: ignore[misc]
        robot, joints = self.config.robot, self._contract.action_joints
        columns = robot.indices(joints)
        lower, upper = robot.lower[columns].astype(np.float32), robot.upper[columns].astype(np.float32)
        self._limits = robot.lower[columns], robot.upper[columns]
        self.action_space = spaces.Box(lower, upper, dtype=np.float32)
        self._longest_ns = ns(self.config.contract.max_duration_s)
        self._max_episode_steps = math.ceil(self.config.contract.max_duration_s * self.config.contract.rate_hz) + 1
        self._session: Session | None = None
        self._generation = 0
        """Generation of the episode; it changes when the robot is stopped or reset."""
        self._ended_by = ""
        """The fault that has ended the episode; empty for none."""
        self._seen: Observation = {}
        """The newest observation."""
        self._rendered: Subscription | None = None
        self._picture: NDArray[np.uint8] | None = None
        self.observation_space = self._spaces()

    def _spaces(self) -> spaces.Dict:
        """The spaces; the run tells the size of the scene's ground truth."""
        self._start()
        first = self._begin(0)
        by_key: dict[str, spaces.Space[Any]] = {}
        for key, value in self._observation(first).items():
            if key == "pixels":
                by_key[key] = spaces.Dict(
                    {name: spaces.Box(0, 255, image.shape, np.uint8) for name, image in value.items()}
                )
            else:
                by_key[key] = spaces.Box(-np.inf, np.inf, value.shape, np.float32)
        return spaces.Dict(by_key)

    def _start(self) -> None:
        def source(session: StreamingRun, mode: Any) -> EnvironmentSource:
            self._source = EnvironmentSource(session, mode)
            return self._source

        request = LaunchRequest(lockstep=True, source=source)
        self._session = session = Session(self.config, installed_plugins(), request)
        self._runtime = Runtime(session)
        if self.render_mode is not None:
            self._rendered = session.bus.subscribe(_RENDERED_TOPIC, 1)
        self._runtime.start()

    def _begin(self, seed: int) -> Frame:
        """Set up the episode of a seed, and run to its first frame."""
        session = self._session
        assert session is not None
        assert isinstance(session.clock, SteppedClock)
        self._source.end()
        session.clock.advance(-session.clock.now_ns() % _ALIGNED_NS)
        self._tick()
        if not session.reset_episode(seed):
            raise HardwareError("the episode cannot begin: an emergency stop is latched")
        if session.held:  # since a fault was reset within an episode; the program wants to go on
            session.bus.call("/set_mode", session.mode)
        self._begun_ns = session.clock.now_ns()
        self._source.begin(seed)
        while (frame := self._source.frame) is None:
            self._tick()
            if session.clock.now_ns() - self._begun_ns > ns(_PATIENCE_S):
                raise HardwareError(f"not all observations have arrived within {_PATIENCE_S:g} s")
        self._generation, self._ended_by = session.generation, ""
        return frame

    def _tick(self) -> None:
        """Run one control period."""
        if self._runtime.step():
            self._runtime.raise_failure()
            raise HardwareError("the run has ended")

    @override
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the episode of a seed, as `ibrobot launch --lockstep --seed SEED` does, or of a random one."""
        super().reset(seed=seed)
        if self._session is None:
            self._start()
        number = int(self.np_random.integers(2**31)) if seed is None else seed
        frame = self._begin(number)
        self._seen = self._observation(frame)
        return self._seen, {"seed": number, **self._info(success=False)}

    @override
    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command joint positions [rad], shape (A,), and run to the next frame, or to the end of the episode.

        Raises:
            ValueError: for an action that is not finite.
            ResetNeeded: after a fault that has ended the episode, until `reset`.
        """
        session, source = self._session, self._source
        if session is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        if self._ended_by:
            raise gymnasium.error.ResetNeeded(f"a fault has ended the episode, call reset: {self._ended_by}")
        wanted = np.asarray(action, dtype=np.float64)
        if not np.isfinite(wanted).all():
            raise ValueError(f"an action must be finite, got {wanted.tolist()}")
        before, fault = source.frame, self._fault()
        if not fault:
            source.act(np.clip(wanted, *self._limits))
        success = truncated = False
        while source.frame is before and not (success or truncated or fault):
            self._tick()
            state, fault = session.state, self._fault()
            success = state is not None and state.generation == self._generation and bool(state.success)
            truncated = not success and session.clock.now_ns() - self._begun_ns > self._longest_ns
        if source.frame is not None and source.frame is not before:
            self._seen = self._observation(source.frame)
        self._ended_by = "" if success else fault
        truncated = truncated or bool(self._ended_by)
        return self._seen, float(success), success, truncated, self._info(success=success)

    def _fault(self) -> str:
        """The fault or emergency stop since which the robot follows no action, also if it was reset; else empty."""
        session = self._session
        assert session is not None
        again = session.generation != self._generation
        return session.stopped_by or ("the robot was reset within the episode" if again else "")

    def _info(self, *, success: bool) -> dict[str, Any]:
        assert self._session is not None
        return {"is_success": success, "factors": dict(self._session.factors), "fault": self._ended_by}

    def _observation(self, frame: Frame) -> Observation:
        observation: Observation = {}
        pixels = {}
        for key, value in frame.values.items():
            if key == STATE:
                observation["agent_pos"] = np.array(value, dtype=np.float32)
            elif key == SCENE:
                observation["environment_state"] = np.array(value, dtype=np.float32)
            elif key.startswith(IMAGES):
                pixels[key.removeprefix(IMAGES)] = np.array(value)
        return {**observation, "pixels": pixels} if pixels else observation

    @override
    def render(self) -> NDArray[np.uint8] | None:
        """The newest picture of the render camera, shape (480, 640, 3); None without a render mode."""
        if self._rendered is None:
            return None
        for received in self._rendered.drain():
            if isinstance(message := received.message, Image):
                self._picture = np.array(message.data).reshape(message.height, message.width, 3)
        if self._picture is None:
            raise gymnasium.error.ResetNeeded("call reset first")
        return self._picture.copy()

    @override
    def close(self) -> None:
        """End the run. Safe to call twice."""
        if self._session is not None:
            if self._rendered is not None:
                self._rendered.close()
                self._rendered = None
            self._runtime.stop()
            self._session = None
