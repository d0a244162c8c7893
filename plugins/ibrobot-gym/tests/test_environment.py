"""The environments: gymnasium's checker, seeds, vectors of environments, and equality with runs in lockstep."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import ibrobot_gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env

from ibrobot_core.app import LaunchRequest, Runtime, Session, find_config, installed_plugins, load_config

CANNOT_RENDER = installed_plugins().missing("sensor", "mujoco")


@contextmanager
def made(name: str, **keywords: Any) -> Iterator[gymnasium.Env[Any, Any]]:
    environment = gymnasium.make(f"ibrobot/{name}", disable_env_checker=True, **keywords)
    try:
        yield environment
    finally:
        environment.close()


@pytest.mark.parametrize("name", ibrobot_gym.ENVIRONMENTS)
def test_gymnasiums_checker_finds_nothing(name: str) -> None:
    with made(name) as environment, warnings.catch_warnings():
        # Its recommendations: actions from -1 to 1, and bounds of observations.
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|infinity).*")
        check_env(environment.unwrapped, skip_render_check=True)


@pytest.mark.skipif(CANNOT_RENDER is not None, reason=str(CANNOT_RENDER))
def test_gymnasiums_checker_finds_nothing_with_cameras_and_pictures() -> None:
    keywords: dict[str, Any] = {"cameras": ("top",), "image_size": (24, 32), "render_mode": "rgb_array"}
    with made("PickCube-v0", **keywords) as environment, warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(symmetric and normalized|infinity).*")
        check_env(environment.unwrapped)
        observation, _ = environment.reset(seed=1)
        assert observation["pixels"]["top"].shape == (24, 32, 3)
        assert np.ptp(observation["pixels"]["top"]) > 50, "the picture is empty"
        assert environment.render().shape == (480, 640, 3)  # type: ignore[union-attr]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_is_refused(value: float) -> None:
    with made("PickCube-v0") as environment:
        environment.reset(seed=7)
        action = np.zeros(environment.action_space.shape or (), dtype=np.float32)
        action[0] = value
        with pytest.raises(ValueError, match="an action must be finite, got"):
            environment.step(action)


def test_seed_is_that_of_a_run_in_lockstep() -> None:
    with made("PickCube-v0") as environment:
        observation, info = environment.reset(seed=7)
    config = load_config(find_config("so101_scenes", installed_plugins()), sim=True)
    session = Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=7, episodes=1))
    runtime = Runtime(session)
    runtime.start()
    for _ in range(5):
        runtime.step()
    factors = dict(session.factors)
    runtime.stop()
    assert info["factors"] == factors
    np.testing.assert_allclose(observation["environment_state"][:2], [factors["cube_x"], factors["cube_y"]], atol=1e-4)


def test_equal_seeds_and_actions_give_equal_episodes() -> None:
    with made("Stack-v0") as one, made("Stack-v0") as other:
        actions = one.action_space
        assert isinstance(actions, Box)
        for environment, before in ((one, 2), (other, 0)):
            for seed in range(before):
                environment.reset(seed=seed)
                environment.step(actions.low)
        ways = []
        for environment in (one, other):
            observation, _ = environment.reset(seed=5)
            way = [observation["agent_pos"]]
            for i in range(10):
                action = np.clip(way[0] + 0.02 * i, actions.low, actions.high)
                way.append(environment.step(action)[0]["agent_pos"])
            ways.append(np.stack(way))
    np.testing.assert_array_equal(ways[0], ways[1])
    assert np.abs(ways[0][-1] - ways[0][0]).max() > 0.05, "the arm did not move"


def test_episode_ends_after_the_contracts_duration_without_success() -> None:
    with made("PickCube-v0", overrides=("contract.max_duration_s=0.5",)) as environment:
        observation, _ = environment.reset(seed=0)
        ends = []
        for _ in range(20):
            observation, reward, terminated, truncated, info = environment.step(observation["agent_pos"])
            ends.append(truncated)
            if truncated:
                break
        assert (reward, terminated, info["is_success"]) == (0.0, False, False)
        assert ends.index(True) == len(ends) - 1 == pytest.approx(0.5 * 30 - 1, abs=2)


def test_vector_of_environments_has_the_episodes_of_single_ones() -> None:
    vector = gymnasium.make_vec("ibrobot/PickCube-v0", num_envs=2, vectorization_mode="sync")
    try:
        observations, infos = vector.reset(seed=3)
    finally:
        vector.close()
    with made("PickCube-v0") as environment:
        for i in range(2):
            observation, info = environment.reset(seed=3 + i)
            np.testing.assert_array_equal(observations["environment_state"][i], observation["environment_state"])
            assert infos["factors"]["cube_x"][i] == info["factors"]["cube_x"]


FAULTS = {
    "a joint that does not follow": "{{kind: freeze_joint, joint: {joint}, at: 0.3}}",
    "a bus that cannot be read": "{{kind: read_error, at: 0.3}}",
    "a bus that is silent": "{{kind: silent, at: 0.3}}",
}


def ended(environment: gymnasium.Env[Any, Any], target: Any, steps: int = 400) -> tuple[int, Any]:
    """Step to the end of an episode; the number of steps, and what the last one returned."""
    for number in range(steps):
        result = environment.step(target)
        if result[2] or result[3]:
            return number + 1, result
    raise AssertionError(f"the episode goes on after {steps} steps")


@pytest.mark.parametrize("joint", ["shoulder_pan", "wrist_flex"])
@pytest.mark.parametrize("fault", FAULTS)
def test_fault_truncates_the_episode_and_stands_in_info(fault: str, joint: str) -> None:
    overrides = (f"simulation.faults=[{FAULTS[fault].format(joint=joint)}]",)
    with made("PickCube-v0", overrides=overrides) as environment:
        actions = environment.action_space
        assert isinstance(actions, Box)
        observation, info = environment.reset(seed=0)
        assert info["fault"] == ""
        up = np.array([1.5, -0.4, -0.4, -1.5, 0.4, 0.4])  # the guard holds an arm with a lame joint above the table
        target = np.clip(observation["agent_pos"] + up, actions.low, actions.high)
        steps, (_, reward, terminated, truncated, info) = ended(environment, target)
        assert (reward, terminated, truncated) == (0.0, False, True)
        assert steps < 30 * 5, "as long as the fault takes to be noticed"
        assert info["fault"]
        with pytest.raises(gymnasium.error.ResetNeeded, match="a fault has ended the episode, call reset: "):
            environment.step(target)
        observation, info = environment.reset(seed=0)
        assert info["fault"] == ""
        assert environment.step(target)[3] is False, "it is another episode"


@pytest.mark.parametrize("reset", [False, True])
@pytest.mark.parametrize("after", [0, 1, 5])
def test_stop_ends_the_episode_even_if_it_was_reset(after: int, reset: bool) -> None:
    with made("PickCube-v0") as environment:
        observation, _ = environment.reset(seed=0)
        target = observation["agent_pos"]
        for _ in range(after):
            observation, *_ = environment.step(target)
        session = environment.unwrapped._session  # type: ignore[attr-defined]
        session.emergency_stop()
        if reset:
            environment.unwrapped._runtime.reset()  # type: ignore[attr-defined]
        seen, _, terminated, truncated, info = environment.step(target)
        assert (terminated, truncated) == (False, True)
        assert ("the robot was reset within the episode" if reset else "emergency stop") in info["fault"]
        np.testing.assert_array_equal(seen["agent_pos"], observation["agent_pos"])
        if reset:
            environment.reset(seed=1)
            assert not environment.step(target)[3]
