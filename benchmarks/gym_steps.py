"""Steps per second of a Gymnasium environment, against a run in lockstep and a bare MuJoCo loop with the same cameras.

    python benchmarks/gym_steps.py [--blocks 10] [--steps 60]

In each block, the three make the same number of steps of a thirtieth of a second, in turns of order; without cameras,
and with two of 320 x 240 pixels. The run is that of the scripted pick. The bare loop steps the physics, reads the
joints and renders. Prints a line of JSON for each, with the median ratios of the times and their quartiles.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from time import perf_counter
from typing import Any

import gymnasium
import ibrobot_gym
import mujoco
import numpy as np
from ibrobot_gym.config import environment_config
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.render import Renderer
from ibrobot_mujoco.so101 import so101

from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins

gymnasium.register_envs(ibrobot_gym)
CAMERAS = ("top", "front")
HEIGHT, WIDTH = 240, 320
RATE_HZ = 30


def environment(cameras: tuple[str, ...]) -> Callable[[int], None]:
    """Steps of the environment: slow swings about the rest pose."""
    env = gymnasium.make("ibrobot/PickCube-v0", cameras=cameras, image_size=(HEIGHT, WIDTH), disable_env_checker=True)
    rest = np.asarray(env.reset(seed=0)[0]["agent_pos"])

    def run(steps: int) -> None:
        env.reset(seed=0)
        for i in range(steps):
            env.step(np.clip(rest + 0.2 * np.sin(0.1 * i), env.action_space.low, env.action_space.high))  # type: ignore[attr-defined]

    return run


def bare(cameras: tuple[str, ...]) -> Callable[[int], None]:
    """The same with MuJoCo alone."""
    options, robot = MujocoOptions(), so101()
    world, scene = build_world(options, robot, visual=False)
    model, data = world.model, world.data
    views = []
    for camera in cameras:
        drawn = build_world(options, robot, visual=True)[0]
        number = drawn.model.camera(camera).id
        views.append((drawn, Renderer(drawn.model, number, WIDTH, HEIGHT, shadows=False)))
    substeps = round(1 / (RATE_HZ * model.opt.timestep))
    rest = robot.pose("rest")

    def run(steps: int) -> None:
        mujoco.mj_resetData(model, data)
        data.qpos[:6] = data.ctrl[:6] = rest
        scene.begin(world, np.random.default_rng(0))
        for i in range(steps):
            data.ctrl[:6] = rest + 0.2 * np.sin(0.1 * i)
            mujoco.mj_step(model, data, substeps)
            data.qpos[:6].astype(np.float32)
            for drawn, renderer in views:
                drawn.data.qpos[:] = data.qpos
                mujoco.mj_forward(drawn.model, drawn.data)
                renderer.render(drawn.data)

    return run


def lockstep(cameras: tuple[str, ...]) -> Callable[[int], None]:
    """The time of as many steps in a run of the scripted pick."""
    config = environment_config("so101_scenes", "pick_cube", cameras, (HEIGHT, WIDTH), None, ())
    session = Session(config, installed_plugins(), LaunchRequest(lockstep=True))
    runtime = Runtime(session)
    runtime.start()

    def run(steps: int) -> None:
        end_ns = session.clock.now_ns() + round(steps * 1e9 / RATE_HZ)
        while session.clock.now_ns() < end_ns:
            runtime.step()

    return run


def timed(run: Callable[[int], None], steps: int) -> float:
    begin = perf_counter()
    run(steps)
    return perf_counter() - begin


def compare(cameras: tuple[str, ...], blocks: int, steps: int) -> dict[str, Any]:
    """Steps per second of both, and quartiles of the paired ratios."""
    runs = {"environment": environment(cameras), "lockstep": lockstep(cameras), "bare": bare(cameras)}
    for run in runs.values():
        run(3)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for block in range(blocks):
        for name in list(runs)[:: 1 if block % 2 else -1]:
            times[name].append(timed(runs[name], steps))
    per_s = {name: round(steps / statistics.median(found)) for name, found in times.items()}
    report: dict[str, Any] = {"cameras": len(cameras), "steps_per_s": per_s}
    for other in ("lockstep", "bare"):
        ratios = [a / b for a, b in zip(times["environment"], times[other], strict=True)]
        low, middle, high = (round(value, 2) for value in statistics.quantiles(ratios, n=4))
        report[f"time over {other}"] = {"median": middle, "quartiles": [low, high]}
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=10)
    parser.add_argument("--steps", type=int, default=60)
    arguments = parser.parse_args()
    for cameras in ((), CAMERAS):
        print(json.dumps(compare(cameras, arguments.blocks, arguments.steps)), flush=True)


if __name__ == "__main__":
    main()
