"""Launch the bundled SO-101 on emulated servos, as a person who installed only the servos' plugin would.

    python tests/house/launch_on_emulators.py PROGRAM

PROGRAM is the command `ibrobot` of an environment. The leader and the follower are emulators of the same environment.
Exits with the status of the run.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path


@contextmanager
def emulator(program: str, calibration: str, environment: dict[str, str]) -> Iterator[str]:
    """The port of an emulated arm with a calibration, which is created."""
    command = [program, "feetech", "emulate", "--calibration", calibration]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.terminate()
            process.stdout.read()


def main() -> int:
    """Launch it for three seconds."""
    program = str(Path(sys.argv[1]).absolute())
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        environment = os.environ | {"XDG_CONFIG_HOME": folder}
        sides = {"hardware": "so101_follower", "teleoperation.leader": "so101_leader"}
        command = [program, "launch", "so101", "--headless", "--duration", "3"]
        command += ["--set", "teleoperation.leader.deadman=none"]  # the deadman is a key, which needs a terminal
        # Emulators beside other work answer late.
        command += ["--set", "control.state_timeout=60"]
        for section, calibration in sides.items():
            for patience in ("retries=200", "lost_replies=2000"):
                command += ["--set", f"{section}.{patience}"]
            port = stack.enter_context(emulator(program, calibration, environment))
            command += ["--set", f"{section}.port={port}"]
        return subprocess.run(command, check=False, env=environment, cwd=Path(folder)).returncode


if __name__ == "__main__":
    sys.exit(main())
