"""A simulated robot for Inspect Robots: its agents, policies and graders drive the scenes of the environments.

    inspect-robots run --task MY_TASK --policy MY_POLICY --embodiment ibrobot -E scene=pick_cube

Needs `pip install "ibrobot-gym[inspect]"`. Source: inspect_robots.embodiment, version 0.60.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, override

import numpy as np
from gymnasium import spaces
from inspect_robots.embodiment import (
    PRIVILEGED_SUCCESS,
    RENDERABLE,
    RESETTABLE,
    SEEDABLE,
    EmbodimentBase,
    EmbodimentInfo,
)
from inspect_robots.errors import EmbodimentFault
from inspect_robots.scene import Scene
from inspect_robots.spaces import ActionSemantics, Box, CameraSpec, ObservationSpace, StateField, StateSpec
from inspect_robots.types import Action, StepResult
from inspect_robots.types import Observation as Seen

from ibrobot_core.api import Contract
from ibrobot_gym.environment import Observation, RobotEnv

_STATE, _SCENE = "joint_pos", "environment_state"


class RobotEmbodiment(EmbodimentBase):
    """A robot in a scene of its simulation, with executors, limits and physics as `ibrobot launch --sim` has them.

    Actions are joint positions [rad], one for each joint of the contract's action. Success is the scene's own.

    Args:
        config: a robot YAML, or the name of a shipped one.
        scene: the type of scene; empty: that of the file.
        cameras: cameras of the scene to observe, or their names with commas between them; none by default.
        image_size: height and width of their pictures [px].
        ground_truth: whether policies see the scene's state, `environment_state`, as only a simulation has it.
        overrides: `path.to.key=value`.
    """

    def __init__(
        self, config: str = "so101_scenes", scene: str = "pick_cube", cameras: str | Sequence[str] = (),
        image_size: tuple[int, int] = (240, 320), ground_truth: bool = False, overrides: Sequence[str] = (),
    ) -> None:  # fmt: skip
        names = tuple(each.strip() for each in cameras.split(",")) if isinstance(cameras, str) else tuple(cameras)
        self._environment = RobotEnv(config, scene or None, "", names, image_size, overrides)
        self._ground_truth, self._instruction = ground_truth, ""
        self.info = self._described()

    def _described(self) -> EmbodimentInfo:
        environment = self._environment
        robot, contract = environment.config.robot, Contract.from_config(environment.config)
        columns = robot.indices(contract.action_joints)
        known: Any = cast("spaces.Dict", environment.observation_space).spaces
        pictures = known["pixels"].items() if "pixels" in known else ()
        fields = [StateField(_STATE, known["agent_pos"].shape, "rad")]
        if self._ground_truth and _SCENE in known:
            fields.append(StateField(_SCENE, known[_SCENE].shape))
        steps = tuple((robot.max_velocity[columns] / contract.rate_hz).tolist())
        return EmbodimentInfo(
            name=f"ibrobot-{robot.name}",
            action_space=Box(
                (len(columns),), robot.lower[columns], robot.upper[columns],
                ActionSemantics("joint_pos", dim_labels=contract.action_joints, max_step=steps),
            ),
            observation_space=ObservationSpace(
                tuple(CameraSpec(name, *space.shape) for name, space in pictures), state=StateSpec(tuple(fields))
            ),
            control_hz=contract.rate_hz,
            is_simulated=True,
            capabilities=frozenset({SEEDABLE, RESETTABLE, PRIVILEGED_SUCCESS, *([RENDERABLE] if pictures else [])}),
            docs=(
                "Actions are absolute joint positions in radians, in the order of the labels. The robot does not move "
                "faster than `max_step` for each step. Joint `gripper`: its lower limit is closed."
            ),
            environment_id=f"ibrobot/{environment.config.robot.name}",
            environment_revision=contract.fingerprint(),
        )  # fmt: skip

    @override
    def reset(self, scene: Scene, *, seed: int | None = None) -> Seen:
        """Begin the episode of a seed: that of the scene, if it has one."""
        self._instruction = scene.instruction
        observation, _ = self._environment.reset(seed=scene.init_seed if scene.init_seed is not None else seed)
        return self._seen(observation)

    @override
    def step(self, action: Action) -> StepResult:
        """Command joint positions, and run to the next frame.

        Raises:
            EmbodimentFault: for an action of another shape, or that is not finite.
        """
        wanted = np.asarray(action.data, dtype=np.float64)
        if wanted.shape != self.info.action_space.shape or not np.isfinite(wanted).all():
            shape = self.info.action_space.shape
            raise EmbodimentFault(f"an action has {shape[0]} finite joint positions, got {wanted.tolist()}")
        observation, reward, success, truncated, info = self._environment.step(wanted.astype(np.float32))
        fault = str(info["fault"])
        reason = "success" if success else "fault" if fault else None
        return StepResult(
            self._seen(observation), reward, success or bool(fault), reason, truncated and not fault,
            {"success": success, "fault": fault},
        )  # fmt: skip

    @override
    def close(self) -> None:
        """End the run. Safe to call twice."""
        self._environment.close()

    def _seen(self, observation: Observation) -> Seen:
        state = {_STATE: np.asarray(observation["agent_pos"], dtype=np.float64)}
        if self._ground_truth and _SCENE in observation:
            state[_SCENE] = np.asarray(observation[_SCENE], dtype=np.float64)
        return Seen(images=dict(observation.get("pixels", {})), state=state, instruction=self._instruction)
