"""How well `ibrobot preflight` finds what is planted in a rig, and how often it accuses one that is as it was.

    python benchmarks/preflight.py [--unchanged 200] [--each 2] [--seed 1]

A simulated SO-101 with rendered cameras, above and in front, on a plain table and on one with a pattern. A reference is
taken of each; then rigs are looked at whose light, objects and arm pose differ from it by chance: `--unchanged` without
a fault, and `--each` with every fault on every table and camera. The arm is masked by the camera of the reference.
Faults of pictures (darker, white balance, blurred, covered) are planted in the rendered pictures, those of zeros in the
readings, `gripper` in the calibration, and `loop` by a control loop that runs at 20 Hz in real time. A camera that
moved by 2 pixels is none: preflight warns at 3 and fails at 5. Prints a table and one JSON object. Exits with 1 if more
than 1 in 200 unchanged rigs is accused, or a camera that moved by 20 pixels or 3 degrees is called unmoved.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from functools import cache, partial
from time import perf_counter
from typing import Any

import attrs
import numpy as np
from apparatus import report
from ibrobot_diagnose.card import Card, make_card
from ibrobot_diagnose.live import look
from ibrobot_diagnose.preflight import Preflight, compared
from ibrobot_diagnose.rig import Rig, Still
from ibrobot_diagnose.watch import LiveWindow
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from ibrobot_core.app import RobotConfig, find_config, installed_plugins, load_config

type Picture = NDArray[np.uint8]

FOVY = 42.0
FOCAL = 240 / math.tan(math.radians(FOVY) / 2)
"""Of pictures of 640 x 480 pixels."""
PLACES = {"above": ((0.16, 0.04, 0.80), (0.16, 0.0401, 0.0)), "front": ((0.75, -0.25, 0.42), (0.14, 0.05, 0.07))}
"""Where the camera is, and where it looks [m]."""
REST = (0.0, -1.57, 1.57, 0.79, 0.0, 0.0)
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
TOP = "observation.images.top"
ENDS = {"wrist_roll": (0, 4095), "gripper": (1500, 2760)}
CALIBRATION = {
    "arm": {
        joint: {"id": i, "drive_mode": 0, "homing_offset": 0, "range_min": low, "range_max": high}
        for i, joint in enumerate(JOINTS, 1)
        for low, high in [ENDS.get(joint, (900, 3200))]
    }
}
MOVED = {f"{pixels} px": math.atan(pixels / FOCAL) for pixels in (2, 5, 20, 40)} | {
    f"{degrees} degrees": math.radians(degrees) for degrees in (1, 3, 10)
}
"""Name -> by how much the camera turns [rad]."""


@attrs.frozen(kw_only=True)
class Setup:
    """A rig."""

    table: str
    place: str
    seed: int = 0
    light: float = 1.0
    pose: tuple[float, ...] = REST
    turn: float = 0.0
    """By how much the camera looks elsewhere [rad], in a direction that the seed decides."""
    exchanged: bool = False
    distractors: int = 2


def options(setup: Setup) -> list[str]:
    """The overrides of the robot YAML."""
    position, target = (np.array(each) for each in PLACES[setup.place])
    ahead = target - position
    angle = np.random.default_rng(setup.seed + 5).uniform(0, 2 * math.pi)
    right = np.cross(ahead, (0.0, 0.0, 1.0) if setup.place == "front" else (1.0, 0.0, 0.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead) / np.linalg.norm(ahead)
    away = math.tan(setup.turn) * np.linalg.norm(ahead) * (math.cos(angle) * right + math.sin(angle) * up)
    camera = {"name": "bench", "pos": position.tolist(), "lookat": (target + away).tolist(), "fovy": FOVY}
    scene = {"type": "pick_cube", "light": setup.light, "distractors": setup.distractors}
    cameras = ("wrist_cam", "bench") if setup.exchanged else ("bench", "wrist_cam")
    return [
        f"simulation.cameras={json.dumps([camera])}", f"simulation.scene={json.dumps(scene)}",
        f"simulation.objects={json.dumps(pattern() if setup.table == 'pattern' else {})}",
        f"robot.description.poses.bench={json.dumps(setup.pose)}", "simulation.start_pose=bench",
        *(f"peripherals.{i}.sim.camera={name}" for i, name in enumerate(cameras)),
    ]  # fmt: skip


@cache
def pattern() -> dict[str, Any]:
    """Flat tiles on the table."""
    rng = np.random.default_rng(3)
    tiles = {}
    for i in range(90):
        size = rng.uniform(0.01, 0.06, 2)
        place = rng.uniform((-0.35, -0.45), (0.65, 0.45))
        tiles[f"tile{i}"] = {
            "shape": "box", "size": [*size.tolist(), 0.001 + 0.0002 * (i % 5)],
            "position": [*place.tolist(), 0.0004 + 0.0001 * (i % 5)], "yaw": float(rng.uniform(0, 3)),
        }  # fmt: skip
    return tiles


def config_of(setup: Setup, *more: str) -> RobotConfig:
    """The robot of a set-up."""
    return load_config(find_config("so101", installed_plugins()), overrides=[*options(setup), *more], sim=True)


def seen(setup: Setup) -> LiveWindow:
    """A look at it."""
    return look(config_of(setup), 0.5, lockstep=True, seed=setup.seed)


@cache
def reference(table: str, place: str) -> tuple[RobotConfig, Card]:
    """The robot as its YAML describes it, and its reference."""
    setup = Setup(table=table, place=place)
    card = make_card([changed(seen(setup)).window])
    return config_of(setup), card


def changed(
    window: LiveWindow, picture: Callable[[Picture], Picture] = lambda shown: shown,
    reads: Callable[[Any], Any] = lambda pose: pose, **more: Any,
) -> LiveWindow:  # fmt: skip
    """The same with other pictures, readings, or evidence; always with a calibration, which a simulation lacks."""

    def still(each: Still) -> Still:
        return attrs.evolve(each, picture=picture(each.picture), pose=reads(each.pose))

    rig: Rig = window.rig
    cameras = {
        key: attrs.evolve(camera, stills=tuple(map(still, camera.stills))) if key == TOP else camera
        for key, camera in rig.cameras.items()
    }
    rig = attrs.evolve(rig, **{"cameras": cameras, "calibration": CALIBRATION, **more})
    return attrs.evolve(window, window=attrs.evolve(window.window, rig=rig))


def blurred(picture: Picture) -> Picture:
    return np.asarray(Image.fromarray(picture).filter(ImageFilter.GaussianBlur(2.0)))


def covered(picture: Picture) -> Picture:
    hidden = picture.copy()
    hidden[:, : picture.shape[1] * 55 // 100] = 25
    return hidden


def warm(picture: Picture) -> Picture:
    return np.clip(picture * np.array([1.2, 1.0, 0.8]), 0, 255).astype(np.uint8)


def darker(picture: Picture) -> Picture:
    return (picture * 0.55).astype(np.uint8)


PICTURES: dict[str, tuple[Callable[[Picture], Picture], str]] = {
    "darker": (darker, "picture_dark"), "white balance": (warm, "white_balance"),
    "blurred": (blurred, "picture_blurred"), "covered": (covered, "picture_covered"),
}  # fmt: skip


def by_chance(table: str, place: str, number: int, *, at_rest: bool | None = None) -> Setup:
    """A rig as in the reference, with other light, objects and, every second time, another pose of the arm."""
    rng = np.random.default_rng(number)
    rests = number % 2 == 0 if at_rest is None else at_rest
    low, high = np.array([-1.2, -1.6, -0.6, -1.0, -1.5, 0.0]), np.array([1.2, 0.2, 1.5, 1.0, 1.5, 1.2])
    pose = REST if rests else tuple(float(f"{each:.4g}") for each in rng.uniform(low, high))
    light, distractors = float(rng.uniform(0.9, 1.1)), int(rng.integers(0, 4))
    setup = Setup(table=table, place=place, seed=number, light=light, pose=pose, distractors=distractors)
    if not rests and seen(setup).rig.conditions:  # the pose is in the table, which throws the arm out of it
        return by_chance(table, place, number + 1_000_000, at_rest=at_rest)
    return setup


def planted(table: str, place: str, number: int) -> Iterator[tuple[str, str, LiveWindow]]:
    """Kind of fault, the cause that it is, and the rig."""
    usual = by_chance(table, place, number)
    for kind, angle in MOVED.items():
        yield f"moved {kind}", "camera_moved", changed(seen(attrs.evolve(usual, turn=angle)))
    yield "exchanged", "cameras_exchanged", changed(seen(attrs.evolve(usual, exchanged=True)))
    whole = seen(usual)
    for kind, (picture, cause) in PICTURES.items():
        yield kind, cause, changed(whole, picture)
    narrow = {"arm": {**CALIBRATION["arm"], "gripper": {**CALIBRATION["arm"]["gripper"], "range_max": 2400}}}
    yield "other gripper", "other_gripper", changed(whole, calibration=narrow)
    rests = by_chance(table, place, number, at_rest=True)
    still = seen(rests)
    joint = number % 4
    for degrees in (2, 5, 17):
        moved = partial(np.add, math.radians(degrees) * np.eye(6)[joint])
        yield f"zero {degrees} degrees", "zero_shifted", changed(still, reads=moved)
    pose = list(REST)
    pose[joint] += math.radians(17) * (-1 if joint == 2 else 1)
    slipped = seen(attrs.evolve(rests, pose=tuple(pose)))
    away = np.array(pose) - REST
    yield "horn slipped", "zero_shifted", changed(slipped, reads=lambda read: read - away)


def slow_loop() -> Preflight:
    """The loop at 20 Hz, in real time, against a reference at 100 Hz."""
    setup = Setup(table="plain", place="above")
    usual = look(config_of(setup), 1.0)
    slow = look(config_of(setup, "control.rate_hz=20", "contract.rate_hz=20"), 1.0)
    return compared(changed(slow), config_of(setup), make_card([changed(usual).window]))


def verdict_of(result: Preflight, cause: str) -> str:
    verdicts = {each.name: each.evidence.verdict for each in result.findings}
    return verdicts.get(cause, "not tested")


def accused(result: Preflight) -> list[str]:
    return [each.name for each in result.findings if each.evidence.verdict in ("warn", "fail")]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--unchanged", type=int, default=200, help="rigs without a fault")
    parser.add_argument("--each", type=int, default=2, help="rigs with each fault, for every table and place")
    parser.add_argument("--seed", type=int, default=1, help="of all rigs; thresholds were chosen on others")
    arguments = parser.parse_args()
    begin = perf_counter()
    scenes = [(table, place) for table in ("plain", "pattern") for place in PLACES]
    alarms, unclear = Counter[str](), 0
    wrong = 0
    for number in range(arguments.unchanged):
        table, place = scenes[number % len(scenes)]
        config, card = reference(table, place)
        result = compared(changed(seen(by_chance(table, place, 10_000 * arguments.seed + number))), config, card)
        names = accused(result)
        wrong += bool(names)
        alarms.update(names)
        unclear += verdict_of(result, "camera_moved") == "cannot tell"
        if names:
            print(f"false alarm: {table} {place} {number}: {names}", file=sys.stderr)
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    errors: dict[str, list[float]] = defaultdict(list)
    for table, place in scenes:
        config, card = reference(table, place)
        for number in range(arguments.each):
            for kind, cause, window in planted(table, place, 10_000 * arguments.seed + 5000 + number):
                result = compared(window, config, card)
                counts[kind, table][verdict_of(result, cause)] += 1
                found = [each.evidence for each in result.findings if each.name == cause and not each.evidence.unclear]
                if kind.endswith("px") and found:
                    errors[kind].append(abs(found[0].number - float(kind.split()[1])))
    loop = slow_loop()
    counts["loop at 20 Hz", "plain"][verdict_of(loop, "loop_slow")] += 1
    print(f"{'planted':20}{'table':10}{'fail':>6}{'warn':>6}{'ok':>6}{'cannot tell':>13}")
    for (kind, table), each in sorted(counts.items(), key=lambda row: row[0][0]):
        numbers = "".join(f"{each[verdict]:>6}" for verdict in ("fail", "warn", "ok"))
        print(f"{kind:20}{table:10}{numbers}{each['cannot tell'] + each['not tested']:>13}")
    for kind, values in errors.items():
        print(f"{kind}: measured to {np.median(values):.2f} pixels, at most {max(values):.2f}")
    print(f"unchanged: {wrong} of {arguments.unchanged} accused ({dict(alarms)}), camera uncertain in {unclear}")
    missed = sum(
        counts[f"moved {kind}", table]["ok"]
        for kind in ("20 px", "40 px", "3 degrees", "10 degrees")
        for table in ("plain", "pattern")
    )
    large = [
        counts[f"moved {kind}", "pattern"]
        for kind in ("5 px", "20 px", "40 px", "1 degrees", "3 degrees", "10 degrees")
    ]
    told = sum(each["fail"] + each["warn"] for each in large) / max(1, sum(each.total() for each in large))
    figures = {
        "unchanged": arguments.unchanged, "accused": wrong, "uncertain": unclear, "missed": missed,
        "moved_on_pattern": told, "px_error": float(np.median([each for values in errors.values() for each in values])),
        "seconds": perf_counter() - begin,
    }  # fmt: skip
    print(json.dumps(figures))
    report(**figures)
    return int(missed > 0 or wrong * 200 > arguments.unchanged)


if __name__ == "__main__":
    sys.exit(main())
