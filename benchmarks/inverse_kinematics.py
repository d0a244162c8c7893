"""Inverse kinematics of the SO-101 in closed form: share of targets solved, deviation, time, refusals.

Run it with `uv run python benchmarks/inverse_kinematics.py`. Targets are tip poses of random configurations within the
limits, exact and rounded to 1e-4, and exactly vertical tool axes. Unreachable targets are 0.6 to 1.5 m away. Times are
processor time, wall time in parentheses. Exits with 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

import numpy as np
from ibrobot_kinematics import KinematicModel, Target, UnreachableError, robot_model, solve

from ibrobot_core.api import Vector, load_config

DIGITS = 4
MEDIAN_MS, REFUSAL_MS = 0.3, 20.0


def configurations(arm: KinematicModel, number: int, seed: int) -> Iterator[Vector]:
    rng = np.random.default_rng(seed)
    for _ in range(number):
        yield arm.lower + rng.random(len(arm.lower)) * (arm.upper - arm.lower)


def vertical(arm: KinematicModel, number: int) -> Iterator[Vector]:
    """Configurations whose tool points exactly down or up."""
    wrist = arm.moving[3]
    for q in configurations(arm, 100 * number, 1):
        tip, _, axes = arm.screws(q)
        sign = np.sign(axes[1:4] @ axes[1])
        z, across = tip.rotation[:, 2], np.cross(axes[1], axes[0])
        pitch = np.arctan2(z @ across, z @ axes[0])
        for goal in (0.0, np.pi):
            turned = q.copy()
            turned[wrist] += sign[2] * ((goal - pitch + np.pi) % (2 * np.pi) - np.pi)
            if arm.lower[wrist] <= turned[wrist] <= arm.upper[wrist]:
                yield turned
                number -= 1
                if not number:
                    return


def position(q: Vector, arm: KinematicModel, rounded: bool) -> Target:
    where = arm.forward(q).position
    return Target(np.round(where, DIGITS) if rounded else where)


def with_axis(q: Vector, arm: KinematicModel, rounded: bool) -> Target:
    tip = arm.forward(q)
    where, axis = tip.position, tip.rotation[:, 2]
    if rounded:
        where, axis = np.round(where, DIGITS), np.round(axis, DIGITS)
    return Target(where, axis=axis / np.linalg.norm(axis))


def measure(name: str, arm: KinematicModel, targets: list[Target], rounded: bool) -> bool:
    """Solves all targets; whether enough were, within the limits of the joints and in time."""
    position_tolerance, rotation_tolerance = (1e-3, 1e-2) if rounded else (1e-6, 1e-5)
    home = (arm.lower + arm.upper) / 2
    solved, outside, took, off, turned = 0, 0, [], [0.0], [0.0]
    for target in targets:
        begin = time.thread_time(), time.perf_counter()
        try:
            q = solve(arm, target, home, position_tolerance=position_tolerance, rotation_tolerance=rotation_tolerance)
        except UnreachableError:
            continue
        finally:
            took.append((time.thread_time() - begin[0], time.perf_counter() - begin[1]))
        solved += 1
        outside += int((q < arm.lower).any() or (q > arm.upper).any())
        tip = arm.forward(q)
        off.append(float(np.linalg.norm(tip.position - target.position)))
        if target.axis is not None:
            turned.append(float(np.linalg.norm(tip.rotation[:, 2] - target.axis)))
    (median, wall), (tail, _) = np.percentile(took, (50, 99), axis=0) * 1e3
    share = solved / len(targets)
    print(
        f"{name:30} {100 * share:.2f} % of {len(targets)}, {outside} outside limits, at most {1e6 * max(off):.1f} um"
        f" and {1e6 * max(turned):.1f} urad off; median {median:.3f} ms ({wall:.3f}), p99 {tail:.1f} ms"
    )
    return share >= (0.999 if rounded else 1.0) and not outside and median < MEDIAN_MS


def refuse(name: str, arm: KinematicModel, targets: list[Target]) -> bool:
    """Asks for targets out of reach; whether all were refused in time with a point within the limits of the joints."""
    home = (arm.lower + arm.upper) / 2
    refused, outside, took = 0, 0, []
    for target in targets:
        begin = time.thread_time(), time.perf_counter()
        try:
            solve(arm, target, home)
        except UnreachableError as error:
            took.append((time.thread_time() - begin[0], time.perf_counter() - begin[1]))
            refused += 1
            outside += int((error.nearest < arm.lower).any() or (error.nearest > arm.upper).any())
    (median, _), (worst, wall) = np.percentile(took, (50, 100), axis=0) * 1e3
    print(
        f"{name:30} {refused} of {len(targets)} refused, {outside} nearest points outside limits; median {median:.1f}"
        f" ms, worst {worst:.1f} ms ({wall:.1f})"
    )
    return refused == len(targets) and not outside and worst < REFUSAL_MS


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", type=int, default=10_000)
    arguments = parser.parse_args()
    arm = robot_model(load_config("configs/so101_blind.yaml").robot)
    number = arguments.targets
    met = []
    for rounded in (False, True):
        how = "rounded" if rounded else "exact"
        anywhere = list(configurations(arm, number, 0))
        met.append(measure(f"position, {how}", arm, [position(q, arm, rounded) for q in anywhere], rounded))
        met.append(measure(f"position with axis, {how}", arm, [with_axis(q, arm, rounded) for q in anywhere], rounded))
        straight = [with_axis(q, arm, rounded) for q in vertical(arm, number // 10)]
        met.append(measure(f"vertical axis, {how}", arm, straight, rounded))
    rng = np.random.default_rng(2)
    for name, axis in (("unreachable position", False), ("unreachable with axis", True)):
        away = rng.normal(size=(number // 10, 3))
        away *= rng.uniform(0.6, 1.5, (number // 10, 1)) / np.linalg.norm(away, axis=1, keepdims=True)
        axes = rng.normal(size=away.shape)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        targets = [Target(p, axis=a if axis else None) for p, a in zip(away, axes, strict=True)]
        met.append(refuse(name, arm, targets))
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
