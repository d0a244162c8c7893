"""The scenes of ibrobot as environments of LeRobot; importing this package registers `--env.type=ibrobot`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gymnasium
import ibrobot_gym
from gymnasium import spaces
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

gymnasium.register_envs(ibrobot_gym)

_KEYS = {"agent_pos": (OBS_STATE, FeatureType.STATE), "environment_state": (OBS_ENV_STATE, FeatureType.ENV)}


@EnvConfig.register_subclass("ibrobot")
@dataclass
class IbrobotEnv(EnvConfig):  # type: ignore[misc]  # LeRobot is not installed where types are checked
    """An environment of `ibrobot_gym`."""

    task: str | None = "PickCube-v0"
    fps: int = 30
    cameras: list[str] = field(default_factory=list)
    image_height: int = 240
    image_width: int = 320
    overrides: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        environment = gymnasium.make(self.gym_id, disable_env_checker=True, **{**self.gym_kwargs, "render_mode": None})
        shapes, actions = environment.observation_space, environment.action_space
        environment.close()
        assert isinstance(shapes, spaces.Dict)
        assert actions.shape is not None
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, actions.shape)}
        self.features_map = {ACTION: ACTION}
        for key, (name, kind) in _KEYS.items():
            if key in shapes.spaces:
                self.features[key] = PolicyFeature(kind, shapes[key].shape)
                self.features_map[key] = name
        for camera in self.cameras:
            key = f"pixels/{camera}"
            self.features[key] = PolicyFeature(FeatureType.VISUAL, (self.image_height, self.image_width, 3))
            self.features_map[key] = f"{OBS_IMAGES}.{camera}"

    @property
    def package_name(self) -> str:
        """The package that registers the environments."""
        return "ibrobot_gym"

    @property
    def gym_id(self) -> str:
        """The id of the environment."""
        return f"ibrobot/{self.task}"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keywords of `RobotEnv`."""
        return {
            "cameras": tuple(self.cameras),
            "image_size": (self.image_height, self.image_width),
            "overrides": tuple(self.overrides),
            "render_mode": "rgb_array",
        }
