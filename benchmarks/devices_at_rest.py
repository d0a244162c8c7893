"""Ten minutes with the deadman held and the device at rest, with the noise and drift of its sensors: nothing moves.

    python benchmarks/devices_at_rest.py [--minutes 10] [--seed 0] [--device hand --device phone --device gamepad]

The simulated SO-101 runs in lockstep. The device's values go through its driver at 50 Hz and more:

- hand: a tracked controller on a table; white noise of 0.25 mm and 1 mrad, drift of 0.2 mm/s and 2 mrad/s;
- phone: orientation sensors, which browsers round to 0.1 degrees; noise of 0.05 degrees, drift of 0.1 degrees/s;
- gamepad: a DualSense; sticks whose rest wanders by 0.06 of their way, with noise of one step of the converter.

Then the device is moved for a second. Prints one line per device, and exits with 1 if a command moves by more than
1e-5 rad before, or not by 0.03 rad then.
"""

from __future__ import annotations

import argparse
import math
import random
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import override

import numpy as np
from ibrobot_kinematics.rotations import exp, quaternion
from ibrobot_webxr.messages import HandPose
from takeovers import CONFIG, WithHand, WithPad

from ibrobot_core.api import Vector
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config

MOST_RAD, LEAST_RAD = 1e-5, 0.03
RATE_HZ = 100
SETTLE_S = 2.0
"""Time before the deadman is pressed, and from then to the first compared command."""
DEGREE = math.pi / 180


class AtRest(ABC):
    """A device at rest."""

    device: str
    """The device in the YAML."""

    @abstractmethod
    def meet(self, runtime: Runtime) -> None:
        """Take up the device once the run has started."""

    @abstractmethod
    def tick(self, time_s: float, pressed: bool, pushed: float, rng: random.Random) -> None:
        """Send what its sensors have at a time [s], with the device moved by a share of the way, 0 to 1."""

    @abstractmethod
    def close(self) -> None:
        """Put the device away."""


class Hand(AtRest):
    """A tracked controller."""

    device = WithHand.device

    def __init__(self) -> None:
        self._hand = WithHand()

    @override
    def meet(self, runtime: Runtime) -> None:
        self._hand.meet(runtime)

    def pose(self, time_s: float, pushed: float, rng: random.Random) -> tuple[Vector | None, Vector]:
        """Position [m], shape (3,), if it is tracked, and rotation matrix, shape (3, 3)."""
        noise = np.array([rng.gauss(0, 1) for _ in range(6)])
        place = np.array([0.1 + 2e-4 * time_s, 1.0 + 0.05 * pushed, -0.3]) + 2.5e-4 * noise[:3]
        return place, exp(np.array([0.0, 2e-3 * time_s, 0.0]) + 1e-3 * noise[3:])

    @override
    def tick(self, time_s: float, pressed: bool, pushed: float, rng: random.Random) -> None:
        place, rotation = self.pose(time_s, pushed, rng)
        position = None if place is None else tuple(place.tolist())
        self._hand.send(HandPose(tuple(quaternion(rotation).tolist()), position, pressed))

    @override
    def close(self) -> None:
        self._hand.close()


class Phone(Hand):
    """A phone without WebXR: angles as browsers give them, in whole tenths of degrees."""

    @override
    def pose(self, time_s: float, pushed: float, rng: random.Random) -> tuple[Vector | None, Vector]:
        alpha, beta, gamma = 30 + 0.1 * time_s, 40.0 + 15 * pushed, 3.0 + 15 * pushed
        angles = (round(each + rng.gauss(0, 0.05), 1) * DEGREE for each in (alpha, beta, gamma))
        z, x, y = (exp(axis * angle) for axis, angle in zip(np.eye(3)[[2, 0, 1]], angles, strict=True))
        return None, z @ x @ y


class Pad(AtRest):
    """A DualSense with worn sticks."""

    device = WithPad.device

    def __init__(self) -> None:
        self._pad = WithPad()

    @override
    def meet(self, runtime: Runtime) -> None:
        """It is plugged in already."""

    @override
    def tick(self, time_s: float, pressed: bool, pushed: float, rng: random.Random) -> None:
        rest = [0.06 * math.sin(time_s / period) for period in (17, 23, 31, 41)]
        x, y, z, w = (each + rng.choice((-1, 0, 1)) / 127.5 for each in rest)
        x = max(-1.0, x - pushed)
        self._pad.send(("left_shoulder",) if pressed else (), (x, y), (z, w))

    @override
    def close(self) -> None:
        self._pad.close()


DEVICES: dict[str, Callable[[], AtRest]] = {"hand": Hand, "phone": Phone, "gamepad": Pad}


def measure(name: str, minutes: float, seed: int) -> tuple[float, float]:
    """The largest movement of a command while the device is at rest, and while it is moved [rad]."""
    device, rng = DEVICES[name](), random.Random(seed)
    overrides = [f"teleoperation={{it: {device.device}}}", "control_modes.teleop.teleop=it"]
    config = load_config(CONFIG, overrides=overrides, sim=True, mode="teleop")
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True)))
    runtime.start()
    try:
        device.meet(runtime)
        time_s = 0.0

        def moved(seconds: float, pressed: bool, push: float) -> float:
            nonlocal time_s
            most, first = 0.0, None
            for i in range(round(seconds * RATE_HZ)):
                device.tick(time_s, pressed, push * i / (seconds * RATE_HZ), rng)
                time_s += 1 / RATE_HZ
                if runtime.step():
                    runtime.raise_failure()
                state = runtime.session.state
                assert state is not None
                first = state.command if first is None else first
                most = max(most, float(np.abs(state.command - first).max()))
            return most

        moved(SETTLE_S, False, 0.0)
        moved(SETTLE_S, True, 0.0)
        found = moved(60 * minutes, True, 0.0), moved(1.0, True, 1.0)
    finally:
        runtime.stop()
        device.close()
    if runtime.session.faults:
        sys.exit(f"{name}: {'; '.join(runtime.session.faults)}")
    return found


def main() -> int:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", action="append", choices=DEVICES)
    arguments = parser.parse_args()
    good = True
    for name in arguments.device or DEVICES:
        still, moved = measure(name, arguments.minutes, arguments.seed)
        print(
            f"{name:8} {arguments.minutes:g} min at rest: the arm moved by at most {still * 1e3:.4f} mrad, "
            f"then with the device by {moved * 1e3:.0f} mrad",
            flush=True,
        )
        good = good and still <= MOST_RAD and moved >= LEAST_RAD
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
