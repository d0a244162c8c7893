"""How well `ibrobot identify` finds parameters that are planted in a simulated SO-101.

    python benchmarks/identify.py [--minutes 5] [--seed 0]

A simulated arm with planted parameters, a weak elbow and a wrist with backlash among them, follows random motions, fast
and slow, wide and small. Its positions are rounded to the encoder's ticks. Prints what was planted and found, and one
JSON object. Exits with 1 if a gain, the damping, the motion that is lost when a command reverses, or the delay is more
than 10 % off, or if a parameter that is called known is more than 10 % off and more than its least deviation.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path
from time import process_time

import attrs
import numpy as np
from apparatus import report
from arm_moves import TICK_NS, moves
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.identification.fit import ARM, KINDS, SHARED
from ibrobot_mujoco.identification.identify import Result, identify
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, JointParameters, as_yaml, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import control_context

from ibrobot_core.api import EpisodeSetup, Vector, resolve_path

ROBOT = so101()
ENCODER_RAD = 2 * np.pi / 4096
ALLOWED = 0.10


def planted(seed: int) -> ArmParameters:
    """The published servo, changed by chance, with a weak joint and one with backlash."""
    rng = np.random.default_rng(seed)
    published = read_parameters(resolve_path("package://ibrobot_mujoco/servos/so101_sts3215.yaml", Path()), ROBOT)
    joints = {
        name: attrs.evolve(
            each,
            kp=each.kp * float(rng.uniform(0.8, 1.4)),
            damping=each.damping * float(rng.uniform(0.8, 1.5)),
            frictionloss=each.frictionloss * float(rng.uniform(0.8, 2.0)),
            backlash=float(rng.uniform(0.0, 0.02)),
            bias=float(rng.uniform(-0.02, 0.02)),
        )
        for name, each in published.joints.items()
    }
    joints["elbow_flex"] = attrs.evolve(joints["elbow_flex"], kp=4.5)
    joints["wrist_roll"] = attrs.evolve(joints["wrist_roll"], backlash=0.04)
    return attrs.evolve(published, delay=0.024, joints=joints)


def recorded(parameters: ArmParameters, commands: Vector) -> Recording:
    """What the arm with these parameters does."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "planted.yaml"
        file.write_text(as_yaml(parameters), encoding="utf-8")
        options = MujocoOptions(parameters=file, scene=scene("empty"), start_pose="home")
        hardware = MujocoHardware(options, control_context("sim", robot=ROBOT, period_ns=TICK_NS))
        hardware.connect()
    hardware.reset(EpisodeSetup(0))
    measured = []
    for command in commands:
        measured.append(hardware.read().position)
        hardware.write(command)
        hardware.advance(TICK_NS)
    hardware.disconnect()
    times = np.arange(len(commands)) * TICK_NS / 1e9
    return Recording("planted", times, commands, times, np.round(np.stack(measured) / ENCODER_RAD) * ENCODER_RAD)


def lost_motion(joint: JointParameters) -> float:
    """How far a command moves before the joint does, when it reverses [rad]: of backlash and friction together."""
    return joint.backlash + 2 * joint.frictionloss / joint.kp


def off(value: float, true: float) -> float:
    """Relative error."""
    return abs(value - true) / max(abs(true), 1e-9)


def wrongly_known(result: Result, true: ArmParameters) -> list[str]:
    """Parameters that are called known and are not within 10 %, nor within the deviation that is good enough."""
    wrong = []
    for each in result.fitted.known:
        planted_value = getattr(true, each.name) if each.joint == ARM else getattr(true.joints[each.joint], each.name)
        enough = (SHARED if each.joint == ARM else KINDS)[each.name].enough
        error = abs(each.value - (planted_value or 0.0))
        if each.confidence == "known" and error > max(ALLOWED * abs(planted_value or 0.0), 2 * enough):
            wrong.append(f"{each.joint}.{each.name}: {each.value:.4g} for {planted_value:.4g}")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0, help="duration of the recording")
    parser.add_argument("--seed", type=int, default=0, help="of the parameters and the motions")
    arguments = parser.parse_args()
    true = planted(arguments.seed)
    recording = recorded(true, moves(60 * arguments.minutes, arguments.seed + 100))
    begin = process_time()
    result = identify(MujocoOptions(), ROBOT, [recording])
    seconds = process_time() - begin
    got = result.parameters
    worst: dict[str, float] = {"delay": off(got.delay, true.delay)}
    print(f"{'joint':15}{'kp':>16}{'damping':>16}{'lost motion [deg]':>20}")
    for name, each in true.joints.items():
        own = got.joints[name]
        pairs = {
            "kp": (own.kp, each.kp),
            "damping": (own.damping, each.damping),
            "lost_motion": (lost_motion(own), lost_motion(each)),
        }
        for what, (value, planted_value) in pairs.items():
            worst[what] = max(worst.get(what, 0.0), off(value, planted_value))
        lost = f"{np.degrees(pairs['lost_motion'][0]):.2f} of {np.degrees(pairs['lost_motion'][1]):.2f}"
        print(f"{name:15}{own.kp:>8.2f} of{each.kp:>5.1f}{own.damping:>9.2f} of{each.damping:>4.1f}{lost:>20}")
    wrong = wrongly_known(result, true)
    for text in wrong:
        print(f"called known, and is not: {text}", file=sys.stderr)
    figures = {
        **{f"worst_{name}": value for name, value in worst.items()},
        "known": sum(each.confidence == "known" for each in result.fitted.known), "wrongly_known": len(wrong),
        "held_out_deg": float(np.rad2deg(result.totals["after"])),
        "before_deg": float(np.rad2deg(result.totals["before"])),
        "baseline_deg": float(np.rad2deg(result.totals["delay_lag_bias"])), "cpu_s": seconds,
    }  # fmt: skip
    print(json.dumps(figures))
    report(**figures)
    return int(max(worst.values()) > ALLOWED or bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
