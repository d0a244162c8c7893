"""The cube is picked over real serial bytes: servos and scene in one process, the robot in another."""

from __future__ import annotations

import json
import os
import queue
import re
import signal
import subprocess
import threading
import time
from collections import deque
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

ROBOT = "so101_emulated"
PATIENCE_S = 60.0


# What a busy machine may cost: replies that come late, and time.
PATIENT = ("hardware.lost_replies=1000", "hardware.retries=200", "control.state_timeout=20.0")


def test_cube_lies_in_the_bin_and_only_the_emulator_says_so(ibrobot: tuple[str, ...], tmp_path: Path) -> None:
    link = tmp_path / "follower"
    environment = {**os.environ, "XDG_CONFIG_HOME": str(tmp_path / "config"), "IBROBOT_FOLLOWER_PORT": str(link)}
    launch = [*ibrobot, "launch", ROBOT, "--headless", "--json", "--duration", "100"]
    launch += [word for each in PATIENT for word in ("--set", each)]
    refused = subprocess.run(launch, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False)
    (remedy,) = re.findall("`ibrobot (.*?)`", refused.stderr.splitlines()[-1])  # it works as it is printed
    with subprocess.Popen(
        (*ibrobot, *remedy.replace("CONFIG", ROBOT).split(), "--throttle"),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as emulator:
        assert emulator.stdout is not None
        said: queue.SimpleQueue[str] = queue.SimpleQueue()
        reading = threading.Thread(target=lambda lines: deque(map(said.put, lines), maxlen=0), args=(emulator.stdout,))
        reading.start()
        try:
            before = [said.get(timeout=PATIENCE_S)]
            while "Ctrl-C ends it" not in before[-1]:
                before.append(said.get(timeout=PATIENCE_S))
            assert f"{link}\n" in before
            with (tmp_path / "out").open("w+") as out, (tmp_path / "err").open("w+") as err:
                run = subprocess.Popen(launch, env=environment, cwd=tmp_path, stdout=out, stderr=err, text=True)
                try:
                    while run.poll() is None and said.empty():
                        time.sleep(0.05)
                    run.send_signal(signal.SIGINT)
                    run.wait(PATIENCE_S)
                finally:
                    run.kill()
                    run.wait()
        finally:
            emulator.terminate()
            reading.join()
    printed = (tmp_path / "out").read_text()
    assert run.returncode == 0, printed + (tmp_path / "err").read_text()
    summary = json.loads(printed.splitlines()[-1])
    assert not summary["simulated"]
    assert summary["faults"] == []
    assert said.get(timeout=PATIENCE_S) == "success: the task of the scene is done\n"
    assert said.empty()
    assert emulator.returncode == 0
    assert not link.is_symlink()
