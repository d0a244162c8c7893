"""Inverse kinematics of the SO-101: share of targets solved, deviation, and the times of solutions and refusals.

    python benchmarks/inverse_kinematics.py [--targets 10000]

Targets are tip positions of random configurations within the limits, alone and with the tool's axis, exact and rounded
to 1e-4. Those to refuse are 0.6 to 1.5 m away, or 1 mm to 5 cm out of reach, or have an axis by chance at a position
within reach. Times are processor time, wall time in parentheses. Exits with 1 when a limit is missed. Tests show the
rest: nearest points of other kinds, vertical tools, and arms of six and seven joints.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

import numpy as np
from apparatus import CONFIGS, report
from ibrobot_kinematics import KinematicModel, Target, UnreachableError, robot_model, solve

from ibrobot_core.api import Vector
from ibrobot_core.app import load_config

DIGITS = 4
MEDIAN_MS, REFUSAL_MS, FARTHER_M = 0.3, 20.0, 1e-4
FIGURES = {"least_share": 1.0, "slowest_median_ms": 0.0, "worst_refusal_ms": 0.0, "farther_mm": 0.0}
"""The worst of all sets of targets."""


class Timed:
    """Asks an arm for targets, from the middle of its limits."""

    def __init__(self, arm: KinematicModel, **tolerances: float) -> None:
        self._arm, self._tolerances = arm, tolerances
        self._took: list[tuple[float, float]] = []

    def ask(self, target: Target) -> Vector | UnreachableError:
        """The joints, within the limits."""
        begin = time.thread_time(), time.perf_counter()
        try:
            found: Vector | UnreachableError = solve(
                self._arm, target, (self._arm.lower + self._arm.upper) / 2, **self._tolerances
            )
        except UnreachableError as error:
            found = error
        self._took.append((time.thread_time() - begin[0], time.perf_counter() - begin[1]))
        joints = found.nearest if isinstance(found, UnreachableError) else found
        if (joints < self._arm.lower).any() or (joints > self._arm.upper).any():
            raise SystemExit(f"{target}: {joints} are outside of the limits")
        return found

    def times_ms(self) -> tuple[float, float, str]:
        """Median and greatest processor time, and both with the wall time, as text."""
        (median, wall), (most, most_wall) = np.percentile(self._took, (50, 100), axis=0) * 1e3
        return median, most, f"median {median:.3f} ms ({wall:.3f}), most {most:.1f} ms ({most_wall:.1f})"


def configurations(arm: KinematicModel, number: int, seed: int) -> Iterator[Vector]:
    rng = np.random.default_rng(seed)
    for _ in range(number):
        yield arm.lower + rng.random(len(arm.lower)) * (arm.upper - arm.lower)


def measure(arm: KinematicModel, number: int, *, axis: bool, rounded: bool) -> bool:
    """Solve targets; whether enough were, near enough and in time. Adds to `FIGURES`."""
    most_off, most_turned = (1e-3, 1e-2) if rounded else (1e-6, 1e-5)
    timed = Timed(arm, position_tolerance=most_off, rotation_tolerance=most_turned)
    off, turned = [0.0], [0.0]
    for q in configurations(arm, number, 0):
        tip = arm.forward(q)
        where, along = tip.position, tip.rotation[:, 2]
        if rounded:
            where, along = np.round(where, DIGITS), np.round(along, DIGITS)
        target = Target(where, axis=along / np.linalg.norm(along) if axis else None)
        found = timed.ask(target)
        if not isinstance(found, UnreachableError):
            missed = target.missed(arm.forward(found))
            off.append(float(missed[0]))
            turned.append(float(missed[1]))
    share, (median, _, text) = (len(off) - 1) / number, timed.times_ms()
    name = f"position{' with axis' * axis}, {'rounded' if rounded else 'exact'}"
    print(
        f"{name:30} {100 * share:.2f} % of {number}, at most {1e6 * max(off):.1f} um and {1e6 * max(turned):.1f} urad"
        f" off; {text}"
    )
    FIGURES["least_share"] = min(FIGURES["least_share"], share)
    FIGURES["slowest_median_ms"] = max(FIGURES["slowest_median_ms"], median)
    near = max(off) <= most_off and max(turned) <= most_turned
    return near and share >= (0.999 if rounded else 1.0) and median < MEDIAN_MS


def refuse(name: str, arm: KinematicModel, targets: list[tuple[Target, float]]) -> bool:
    """Ask for targets out of reach; whether all were refused in time, with a point as near as the known one [m]."""
    timed, farther = Timed(arm), [0.0]
    for target, known in targets:
        found = timed.ask(target)
        if isinstance(found, UnreachableError):
            farther.append(found.position_error - known)
    _, worst, text = timed.times_ms()
    print(
        f"{name:30} {len(farther) - 1} of {len(targets)} refused, at most {1e3 * max(farther):.2f} mm farther; {text}"
    )
    FIGURES["worst_refusal_ms"] = max(FIGURES["worst_refusal_ms"], worst)
    FIGURES["farther_mm"] = max(FIGURES["farther_mm"], 1e3 * max(farther))
    return len(farther) == len(targets) + 1 and max(farther) < FARTHER_M and worst < REFUSAL_MS


def unit(rng: np.random.Generator) -> Vector:
    direction = rng.normal(size=3)
    return np.asarray(direction / np.linalg.norm(direction))


def far(rng: np.random.Generator) -> Vector:
    """A position beyond the reach of the SO-101 [m]."""
    return unit(rng) * rng.uniform(0.6, 1.5)


def just_out_of_reach(arm: KinematicModel, number: int) -> Iterator[tuple[Target, float]]:
    """Positions 1 mm to 5 cm out of reach, and how far, on the way from the nearest point of a far position to it.

    That point is the nearest of all positions on the way.
    """
    rng, timed = np.random.default_rng(4), Timed(arm)
    for _ in range(number):
        away = far(rng)
        error = timed.ask(Target(away))
        assert isinstance(error, UnreachableError)
        out = rng.uniform(1e-3, 0.05)
        yield Target(error.position + out * (away - error.position) / error.position_error), out


def sideways(arm: KinematicModel, number: int) -> Iterator[tuple[Target, float]]:
    """Positions within reach, with an axis that leaves the plane in which the arm bends; the position is met."""
    for q in configurations(arm, number, 5):
        tip, _, axes = arm.screws(q)
        yield Target(tip.position, axis=0.6 * tip.rotation[:, 2] + 0.8 * axes[1] / np.linalg.norm(axes[1])), 0.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--targets", type=int, default=10_000)
    number = parser.parse_args().targets
    arm, rng = robot_model(load_config(CONFIGS / "so101_blind.yaml").robot), np.random.default_rng(2)
    met = [measure(arm, number, axis=axis, rounded=rounded) for rounded in (False, True) for axis in (False, True)]
    few = range(number // 40)
    refused = {
        "far": [(Target(far(rng)), np.inf) for _ in few],
        "far, with axis": [(Target(far(rng), axis=unit(rng)), np.inf) for _ in few],
        "1 mm to 5 cm out of reach": list(just_out_of_reach(arm, number // 10)),
        "impossible axis": list(sideways(arm, number // 40)),
    }
    met += [refuse(name, arm, asked) for name, asked in refused.items()]
    report(**FIGURES)
    return 0 if all(met) else 1


if __name__ == "__main__":
    sys.exit(main())
