"""The safety layer under random requests: every command of a million sequences is within the limits.

Each joint is a sequence of its own, with limits of its own, so that one tick of the layer advances a thousand of them.
Requests jump, walk, run along limits, land exactly on them, and are not finite; joints follow exactly, with a lag, or
stay where they are. Where a joint follows exactly, all four limits hold without exception; elsewhere position and lead.

    python benchmarks/safety_sequences.py                     # a million sequences
    python benchmarks/safety_sequences.py --sequences 20000   # fewer
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.robot import Joint, Robot, Vector

JOINTS = 1000
TICKS = 120
PERIOD_NS = 10_000_000
PERIOD_S = PERIOD_NS / 1e9
ROUNDING = 1e-6
"""Share of a limit by which rounding may exceed it."""
KINDS = ("jumps", "walks", "runs at the limit", "ends", "stops and goes", "not finite")


def make_robot(rng: np.random.Generator) -> Robot:
    """Joints with random limits."""
    joints = []
    for number in range(JOINTS):
        lower, span = rng.uniform(-3, 1), 10 ** rng.uniform(-1.5, 0.8)
        velocity, acceleration = 10 ** rng.uniform(-1, 1), 10 ** rng.uniform(-0.5, 2)
        joints.append(Joint(f"j{number}", lower, lower + span, max_velocity=velocity, max_acceleration=acceleration))
    return Robot("random", tuple(joints))


def requests(rng: np.random.Generator, robot: Robot, kinds: np.ndarray, tick: int, last: Vector) -> Vector:
    """The desired positions of a tick [rad], shape (J,), each by its joint's kind of sequence."""
    lower, upper, step = robot.lower, robot.upper, robot.max_velocity * PERIOD_S
    anywhere = rng.uniform(lower - 0.3, upper + 0.3)
    ends = np.where(rng.random(JOINTS) < 0.5, lower, upper)
    jump = rng.random(JOINTS) < 0.08
    found = last.copy()
    found = np.where((kinds == 0) & (jump | (tick == 0)), anywhere, found)
    found = np.where(kinds == 1, last + rng.normal(0, 1, JOINTS) * step * rng.choice([0.1, 1, 3], JOINTS), found)
    found = np.where(kinds == 2, last + step * np.where((tick // 40) % 2, -1, 1), found)
    found = np.where((kinds == 3) & (jump | (tick == 0)), ends, found)
    found = np.where((kinds == 4) & jump, last + rng.uniform(-1, 1, JOINTS) * step * 10, found)
    wild = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308], JOINTS)
    return np.where((kinds == 5) & jump, wild, np.where((kinds == 5) & (tick % 7 == 0), anywhere, found))


def run(rng: np.random.Generator) -> tuple[dict[str, float], list[str]]:
    """The largest share of each limit that a thousand sequences used, and what exceeded one."""
    robot = make_robot(rng)
    layer = SafetyLayer(robot, PERIOD_NS)
    lower, upper = robot.lower, robot.upper
    start = rng.uniform(lower, upper)
    start = np.where(rng.random(JOINTS) < 0.2, np.where(rng.random(JOINTS) < 0.5, lower, upper), start)
    layer.activate(start)
    kinds = rng.integers(len(KINDS), size=JOINTS)
    follows = rng.random(JOINTS) < 0.7
    lag = rng.uniform(0.05, 1.0, JOINTS)
    stopped_at = rng.integers(TICKS, size=JOINTS)
    before, speed, measured, wanted = start, np.zeros(JOINTS), start.copy(), start.copy()
    worst = dict.fromkeys(("position", "lead", "velocity", "acceleration"), 0.0)
    wrong: list[str] = []
    for tick in range(TICKS):
        wanted = requests(rng, robot, kinds, tick, np.where(np.isfinite(wanted), wanted, before))
        asked = np.where(tick > stopped_at, np.nan, wanted)
        command = layer.apply(asked, measured)
        step = (command - before) / PERIOD_S
        shares = {
            "position": np.maximum(lower - command, command - upper) / (upper - lower),
            "lead": np.abs(command - measured) / robot.max_lead - 1,
            "velocity": np.where(follows, np.abs(step) / robot.max_velocity - 1, -1),
            "acceleration": np.where(follows, np.abs(step - speed) / PERIOD_S / robot.max_acceleration - 1, -1),
        }
        for name, share in shares.items():
            most = int(np.argmax(share))
            worst[name] = max(worst[name], float(share[most]))
            if not share[most] <= ROUNDING:
                wrong.append(f"{name} exceeded by {share[most]:.2g} of its limit, {KINDS[kinds[most]]}, tick {tick}")
        before, speed = command, step
        measured = np.where(follows, command, measured + (command - measured) * lag)
    return worst, wrong


def main() -> int:
    """Print a table; 1 if a limit was exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sequences", type=int, default=1_000_000, help="number of sequences")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first thousand")
    asked = parser.parse_args()
    worst: dict[str, float] = {}
    wrong: list[str] = []
    rounds = -(-asked.sequences // JOINTS)
    for number in range(rounds):
        shares, faults = run(np.random.default_rng(asked.seed + number))
        worst = {name: max(worst.get(name, 0.0), share) for name, share in shares.items()}
        wrong += [f"seed {asked.seed + number}: {fault}" for fault in faults]
    print(f"{rounds * JOINTS} sequences of {TICKS} ticks")
    for name, share in worst.items():
        print(f"{name:12} exceeded by at most {share:.1e} of its limit")
    for fault in wrong[:20]:
        print(fault)
    print(f"{len(wrong)} ticks beyond a limit")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
