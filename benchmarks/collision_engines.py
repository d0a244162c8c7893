"""Time of one collision check of the SO-101 with 5 mm padding by several engines, and whether they agree.

    python benchmarks/collision_engines.py

The figures decided for Pinocchio's naive broadphase with Coal, and for hulls of links that are checked first: ADR 31.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np
import pinocchio
from ibrobot_planning.world.checked_arm import with_hulls
from ibrobot_planning.world.collision import Collisions
from planning import Referee
from planning_scenes import ARM_JOINTS, KINDS, PADDING_M, Maker, so101

from ibrobot_core.api import Vector

CONFIGURATIONS = 2000
MANAGERS = ("Naive", "SSaP", "DynamicAABBTree")

FREE = ("Naive, free", "hulls, free")
"""Of these, the time of configurations in which nothing touches, as three of four are in a search."""


def timed(check: Callable[[Vector], bool], configurations: Vector) -> tuple[float, list[bool]]:
    """CPU time of a check [µs], and its answers."""
    check(configurations[0])
    begun = time.process_time()
    answers = [bool(check(q)) for q in configurations]
    return (time.process_time() - begun) / len(configurations) * 1e6, answers


def main() -> None:
    maker, robot = Maker(), so101()
    hulls = with_hulls(maker.arm)
    samples = np.random.default_rng(0).uniform(robot.lower[:5], robot.upper[:5], (CONFIGURATIONS, 5))
    print(
        f"{'':12s} {'objects':>8s} {'free':>6s} "
        + " ".join(f"{name:>16s}" for name in ("all pairs", *MANAGERS, "hulls first", "MuJoCo"))
    )
    for kind in KINDS:
        world = maker.problem(kind, 0).world
        checks = maker.checks(world)
        model, data, shapes, results = checks.arm.model, checks.data, checks.geometry, checks.results
        native = checks.native(samples)
        columns = []
        took, expected = timed(partial(native_check, (model, data, shapes, results)), native)
        columns.append(f"{took:.1f} µs")
        for name in MANAGERS:
            manager = getattr(pinocchio, f"BroadPhaseManager_{name}CollisionManager")(model, shapes, results)
            took, answers = timed(partial(native_check, (model, data, manager)), native)
            differ = sum(a != b for a, b in zip(answers, expected, strict=True))
            columns.append(f"{took:.1f} µs" + (f" ({differ} differ)" if differ else ""))
        quick = Collisions(hulls, world, ARM_JOINTS, padding=PADDING_M)
        took, answers = timed(quick.touches, native)
        differ = sum(a != b for a, b in zip(answers, expected, strict=True))
        columns.append(f"{took:.1f} µs" + (f" ({differ} differ)" if differ else ""))
        took, answers = timed(mujoco_check(Referee(world)), samples)
        columns.append(f"{took:.1f} µs")
        nothing = native[~np.array(expected)]
        for each in (checks, quick):
            columns.append(f"{timed(each.touches, nothing)[0]:.1f} µs")
        free = 1 - np.mean(expected)
        print(f"{kind:12s} {len(world.objects):8d} {free:6.0%} " + " ".join(f"{column:>16s}" for column in columns))


def native_check(engine: tuple[Any, ...], q: Vector) -> bool:
    """Pinocchio's kinematics and collisions, up to the first contact."""
    return bool(pinocchio.computeCollisions(*engine, q, True))


def mujoco_check(referee: Referee) -> Callable[[Vector], bool]:
    """MuJoCo's kinematics and collisions; its contacts among the arm's links count too, other than with an SRDF."""
    model, data = referee.model, referee.data
    model.geom_margin[:] = PADDING_M

    def check(q: Vector) -> bool:
        data.qpos[:5] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        return data.ncon > 0

    return check


if __name__ == "__main__":
    main()
