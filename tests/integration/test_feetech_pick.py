"""The cube is picked over real serial bytes: servos and scene in one process, the robot in another."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

ROBOT = "so101_emulated"


def test_cube_lies_in_the_bin_and_only_the_emulator_says_so(ibrobot: tuple[str, ...], tmp_path: Path) -> None:
    link = tmp_path / "follower"
    environment = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path / "config"), "IBROBOT_FOLLOWER_PORT": str(link)}
    emulate = (*ibrobot, "feetech", "emulate", "--physics", ROBOT, "--throttle")
    launch = (*ibrobot, "launch", ROBOT, "--headless", "--json", "--duration", "20")
    with subprocess.Popen(
        (*emulate, "--link", str(link), "--calibration", "emulated"),
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as emulator:  # fmt: skip
        try:
            assert emulator.stdout is not None
            before = []
            for line in emulator.stdout:
                before.append(line)
                if "Ctrl-C ends it" in line:
                    break
            assert emulator.poll() is None, "".join(before)
            assert f"{link}\n" in before
            ran = subprocess.run(
                launch, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
            )
            emulator.send_signal(signal.SIGTERM)
            said = emulator.stdout.read()
        finally:
            emulator.terminate()
    assert ran.returncode == 0, ran.stdout + ran.stderr
    summary = json.loads(ran.stdout.splitlines()[-1])
    assert not summary["simulated"]
    assert summary["faults"] == []
    assert said == "success: the scene's task is done\n"
    assert emulator.returncode == 0
    assert not link.is_symlink()
