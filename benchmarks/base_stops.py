"""Random sequences with a mobile base: how it comes to stand after STOP, at faults of its device, and without commands.

    python benchmarks/base_stops.py [--sequences N] [--seed N]

Twists drive a base of LeRobot's, in one of six directions, through the teleop, control and the hardware `lerobot`, in
simulated time. Its wheels keep their last velocity, and reach 60 to 100 % of what they are sent. Then somebody presses
STOP, the loop starves, the twists end, or the device has one of the faults of the plugin's `tests/driving.py`. A reset
follows while the twists go on. Exits with 1 if the base stands later than 0.3 s after STOP, a release or the last
twist, or than 0.5 s after the fault, goes back by more than a millimetre, or moves before a new press of the deadman.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/shared"))
from figures import report
from plugin_tests import of_tests

STOP_S, FAULT_S, BACK_M = 0.3, 0.5, 0.001


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.disable()
    driving = of_tests("ibrobot-plugin-lerobot-devices", "driving")
    random = np.random.default_rng(options.seed)
    found = defaultdict(list)
    failed = []
    with pytest.MonkeyPatch.context() as patches:
        drive = driving.Drive(patches)
        for number in range(options.sequences):
            each = driving.sequence(drive, random)
            found[each.event if each.faulted or each.event not in driving.FAULTS else "stop after a fault"].append(each)
            # A process may stop just before STOP, which is a fault afterwards.
            limit_s = FAULT_S if each.faulted or each.event in driving.PROCESS else STOP_S
            if each.stand.time_s > limit_s or each.stand.back > BACK_M or each.moved_s or not each.is_reset:
                failed.append(f"{number}: {each}")
        drive.close()
    print(f"{'event':20} {'times':>5} {'stands [s]':>10} {'way [m]':>8} {'back [mm]':>9}, the worst of each")
    for event, sequences in sorted(found.items()):
        stands = [each.stand for each in sequences]
        worst = [max(getattr(stand, name) for stand in stands) for name in ("time_s", "way", "back")]
        print(f"{event:20} {len(stands):5} {worst[0]:10.3f} {worst[1]:8.3f} {worst[2] * 1e3:9.2f}")
    stands = [each.stand for sequences in found.values() for each in sequences]
    report(failed=len(failed), slowest_s=max(s.time_s for s in stands), back_mm=1e3 * max(s.back for s in stands))
    print(f"{options.sequences} sequences, {len(failed)} failed", *failed, sep="\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
