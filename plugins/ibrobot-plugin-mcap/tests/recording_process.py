"""Records joint states until it is killed; prints the stamp of each when it was handed over. Not a test."""

from __future__ import annotations

import sys
from pathlib import Path

from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import EpisodeStart, Header, JointState, RealClock


def main(directory: Path, rate_hz: float, compression: str) -> None:
    clock = RealClock()
    recorder = McapRecorder(McapOptions(compression=compression), host_context(clock=clock))
    start_ns = clock.now_ns()
    recorder.begin(EpisodeStart(directory, start_ns, {"/joint_states": JointState.ros_type}, {"prompt": "pick"}))
    count = 0
    while True:
        stamp_ns = clock.now_ns()
        recorder.write("/joint_states", JointState(Header(count), ("pan",), [float(count)]), stamp_ns)
        print(stamp_ns, flush=True)
        count += 1
        clock.sleep_until(start_ns + int(count * 1e9 / rate_hz))


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]), sys.argv[3])
