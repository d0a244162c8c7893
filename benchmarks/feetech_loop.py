"""The control loop at 200 Hz on a servo bus with the wire times of 1 Mbaud, for a minute.

    python benchmarks/feetech_loop.py

`ibrobot feetech emulate --throttle` is the bus, `ibrobot launch` the robot: each tick reads position, velocity and load
of six servos and writes six goals, in the control process. Exits with 1 when a tick was missed or a request repeated.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

YAML = """
robot:
  name: loop
  joints:
    - {{name: shoulder_pan, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: shoulder_lift, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: elbow_flex, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: wrist_flex, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: wrist_roll, lower: -1.5, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
    - {{name: gripper, lower: -0.17, upper: 1.5, max_velocity: 3.0, max_acceleration: 40.0}}
  groups: {{all: [shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper]}}
hardware: {{type: feetech_so101, port: {port}, calibration: {calibration}}}
executors: {{position: {{type: position, group: all}}}}
control_modes: {{idle: {{executors: [position]}}}}
default_control_mode: idle
control: {{rate_hz: {rate}}}
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=200.0, help="of the control loop [Hz]")
    arguments = parser.parse_args()
    ibrobot = str(Path(sys.executable).with_name("ibrobot"))
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "loop.json"
        emulate = [ibrobot, "feetech", "emulate", "--throttle", "--calibration", str(calibration)]
        environment = {**os.environ, "XDG_CONFIG_HOME": folder}
        bus = subprocess.Popen(emulate, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment)
        try:
            assert bus.stdout is not None
            robot = Path(folder) / "loop.yaml"
            port = bus.stdout.readline().strip()
            robot.write_text(YAML.format(port=port, calibration=calibration, rate=arguments.rate))
            launch = [ibrobot, "launch", str(robot), "--headless", "--json", "--duration", str(arguments.seconds)]
            run = subprocess.run(launch, capture_output=True, text=True, check=False)
            if run.returncode:
                print(run.stderr, file=sys.stderr)
                return 1
        finally:
            bus.terminate()
            bus.wait()
    summary = json.loads(run.stdout.splitlines()[-1])
    counts = summary["counters"]["hardware"]["hardware"]
    print(json.dumps({"loop": summary["loop"], "bus": counts, "faults": summary["faults"]}, indent=2))
    return 1 if summary["loop"]["missed"] or counts["retries"] or counts["timeouts"] or summary["faults"] else 0


if __name__ == "__main__":
    sys.exit(main())
