"""`pip install ibrobot-plugin-feetech`, then `ibrobot launch so101`, with emulated servos."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest
from ibrobot_testing import ibrobot_command

PATIENCE = (
    "control.state_timeout=60",
    "control.peer_timeout=5",
    *(
        f"{arm}.{option}"
        for arm in ("hardware", "teleoperation.leader")
        for option in ("retries=200", "lost_replies=2000")
    ),
)
"""A busy machine may not run an emulator for tens of milliseconds."""


@contextmanager
def emulated(name: str, environment: dict[str, str]) -> Iterator[str]:
    """An emulated arm with a calibration of this name; gives its port."""
    command = (*ibrobot_command(), "feetech", "emulate", "--calibration", name)
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as ran:
        try:
            assert ran.stdout is not None
            yield ran.stdout.readline().strip()
        finally:
            ran.terminate()


@pytest.mark.skipif(
    find_spec("ibrobot_camera") is not None, reason="`nox -s 'plugin(feetech)'` runs it, without others"
)
@pytest.mark.parametrize("name", ["so101", "so101.yaml"])
def test_launch_of_the_bundled_robot_needs_no_other_package(name: str, tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path)}
    with emulated("so101_follower", environment) as follower, emulated("so101_leader", environment) as leader:
        ports = {"IBROBOT_FOLLOWER_PORT": follower, "IBROBOT_LEADER_PORT": leader}
        command = [*ibrobot_command(), "launch", name, "--headless", "--duration", "0.5"]
        for setting in ("teleoperation.leader.deadman=none", *PATIENCE):
            command += ["--set", setting]
        ran = subprocess.run(
            command, env={**environment, **ports}, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
        )
    assert ran.returncode == 0, ran.stderr
    assert "so101: teleop for" in ran.stdout
