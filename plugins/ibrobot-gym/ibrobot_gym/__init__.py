"""Gymnasium environments of ibrobot; importing this package registers them.

import gymnasium, ibrobot_gym
env = gymnasium.make("ibrobot/PickCube-v0")
"""

from __future__ import annotations

import gymnasium

ENVIRONMENTS = {
    "PickCube-v0": ("so101_scenes", "pick_cube", "put the cube into the bin"),
    "Push-v0": ("so101_scenes", "push", "push the block onto the green mark"),
    "Stack-v0": ("so101_scenes", "stack", "put the red cube on the blue one"),
    "Handover-v0": ("bi_so101_handover", "handover", "hand the bar from the left arm to the right one"),
    "Drawer-v0": ("so101_scenes", "drawer", "open the drawer"),
    "Sort-v0": ("so101_scenes", "sort", "put each cube into the bin of its colour"),
}
"""Name -> robot YAML, scene, and task in words. The ids begin with `ibrobot/`."""

for _name, (_config, _scene, _task) in ENVIRONMENTS.items():
    gymnasium.register(
        id=f"ibrobot/{_name}",
        entry_point="ibrobot_gym.environment:RobotEnv",
        kwargs={"config": _config, "scene": _scene, "task": _task},
    )
