"""The robot as an embodiment of Inspect Robots: its checks, and its evaluation with policies."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ibrobot_core.api import Frame, ns
from ibrobot_core.app import find_config, installed_plugins, load_config

if find_spec("inspect_robots") is None:
    pytest.skip('needs inspect-robots: pip install "ibrobot-gym[inspect]"', allow_module_level=True)

import inspect_robots
from ibrobot_gym.embodiment import RobotEmbodiment
from inspect_robots.conformance import assert_embodiment_conformant
from inspect_robots.errors import EmbodimentFault
from inspect_robots.policy import PolicyConfig, PolicyInfo
from inspect_robots.registry import registered
from inspect_robots.scene import Scene
from inspect_robots.scorer import success_at_end
from inspect_robots.task import Task
from inspect_robots.types import Action, ActionChunk, Observation

SCENES = [Scene(id=f"cube-{seed}", instruction="put the cube into the bin", init_seed=seed) for seed in (1, 2)]


@pytest.fixture
def embodiment() -> Iterator[RobotEmbodiment]:
    made = RobotEmbodiment(ground_truth=True)
    yield made
    made.close()
    made.close()


class Scripted:
    """The scripted policy of the scene, as a policy of Inspect Robots.

    Args:
        embodiment: whose spaces it has.
        moves: whether it moves at all.
    """

    def __init__(self, embodiment: RobotEmbodiment, *, moves: bool = True) -> None:
        self.info = PolicyInfo("scripted", embodiment.info.action_space, embodiment.info.observation_space)
        self.config = PolicyConfig()
        self._moves = moves
        self._rate_hz = embodiment.info.control_hz or 0.0
        config = load_config(find_config("so101_scenes", installed_plugins()), sim=True, mode="pick_cube")
        self._policy = installed_plugins().build_policy(config, "pick_cube")
        self._policy.load()

    def reset(self, scene: Scene) -> None:
        self._policy.reset(0)
        self._now_ns = 0

    def act(self, observation: Observation) -> ActionChunk:
        state = np.asarray(observation.state["joint_pos"])
        if not self._moves:
            return ActionChunk([Action(state)])
        values = {"observation.state": state, "observation.environment_state": observation.state["environment_state"]}
        tensors = self._policy.preprocess(Frame(self._now_ns, values))
        actions = self._policy.postprocess(self._policy.infer(tensors))
        self._now_ns += ns(len(actions) / self._rate_hz)  # each chunk is carried out to its end
        return ActionChunk([Action(each) for each in actions])


def evaluated(embodiment: RobotEmbodiment, policy: Any, folder: Path, scenes: list[Scene], steps: int) -> list[float]:
    """The score of each trial."""
    task = Task(name="pick", scenes=scenes, scorer=success_at_end(), max_steps=steps)
    (log,) = inspect_robots.eval(task, policy, embodiment, log_dir=str(folder), sinks=[])
    assert log.status == "success", log
    return [score for each in log.samples for score in each.reduced.values()]


def test_its_own_checks_find_nothing(embodiment: RobotEmbodiment) -> None:
    assert_embodiment_conformant(embodiment.info)
    assert registered("embodiment")["ibrobot"] is RobotEmbodiment


def test_ground_truth_distinguishes_policies(embodiment: RobotEmbodiment, tmp_path: Path) -> None:
    assert evaluated(embodiment, Scripted(embodiment), tmp_path, SCENES, 600) == [1.0, 1.0]
    assert evaluated(embodiment, Scripted(embodiment, moves=False), tmp_path, SCENES[:1], 20) == [0.0]


def test_a_seed_says_where_the_cube_is(embodiment: RobotEmbodiment) -> None:
    one, again, other = (embodiment.reset(SCENES[i]).state["environment_state"] for i in (0, 0, 1))
    np.testing.assert_array_equal(one, again)
    assert np.abs(other - one).max() > 1e-3


def test_ground_truth_is_hidden_by_default() -> None:
    plain = RobotEmbodiment()
    assert list(plain.reset(SCENES[0]).state) == ["joint_pos"]
    assert plain.info.observation_space.state_keys == {"joint_pos"}
    plain.close()


@pytest.mark.parametrize("action", [[0.0], [np.nan] * 6, [[0.0] * 6]], ids=["short", "nan", "nested"])
def test_wrong_actions_are_refused(embodiment: RobotEmbodiment, action: Any) -> None:
    embodiment.reset(SCENES[0])
    with pytest.raises(EmbodimentFault, match="an action has 6 finite joint positions, got"):
        embodiment.step(Action(np.array(action)))
