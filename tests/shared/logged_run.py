"""Whole runs on a made-up arm that logs every command, as processes that a test stops, kills and blocks."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import attrs
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

PATIENCE_S = 120.0


ROBOT = """
robot:
  name: mini
  joints:
    - {name: pan, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}
    - {name: lift, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}
  groups: {arm: [pan, lift]}
  description:
    poses: {rest: [-1.2, 1.2], far: [-2.7, 2.7]}
hardware: {type: logged, log: commands.log}
executors:
  arm_position: {type: position, group: arm}
models:
  lost: {type: lost}
control_modes:
  teleop: {executors: [arm_position], teleop: swing}
  policy: {executors: [arm_position], inference: {model: lost}}
default_control_mode: teleop
teleoperation:
  swing: {type: swing}
contract:
  rate_hz: 30
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.lift]}
  actions:
    - {executor: arm_position, topic: /arm/commands}
control: {rate_hz: 100, stop: hold}
"""


def wait_for(condition: Callable[[], bool], what: str, why: Callable[[], str] = str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s; {why()}"
        time.sleep(0.005)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return pid > 0 and Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


@attrs.define
class Run:
    """A launched robot."""

    folder: Path
    host: subprocess.Popen[bytes]
    control: int = 0
    children: list[int] = attrs.field(factory=list)

    @property
    def log(self) -> list[list[str]]:
        """The arm's setpoints so far: word, monotonic time [ns], positions [rad]; whole lines only."""
        path = self.folder / "commands.log"
        text = path.read_text() if path.exists() else ""
        return [line.split() for line in text.rpartition("\n")[0].splitlines()]

    def commands(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Times [ns], shape (N,), and positions [rad], shape (N, 2), of all commands."""
        written = [line for line in self.log if line[0] == "write"]
        return np.array([int(w[1]) for w in written]), np.array([[float(p) for p in w[2:]] for w in written])

    def moves(self) -> NDArray[np.int64]:
        """Times of the commands that moved the arm [ns], shape (M,)."""
        times, positions = self.commands()
        return times[1:][np.abs(np.diff(positions, axis=0)).max(axis=1) > 0]

    def is_swinging(self) -> bool:
        """Whether the arm's setpoints move fast now."""
        _, positions = self.commands()
        return len(positions) > 20 and bool(np.abs(np.diff(positions[-3:], axis=0)).min() > 0.02)

    def errors(self) -> str:
        """Standard error so far."""
        return (self.folder / "errors.txt").read_text()

    def find_control(self) -> None:
        """Learn the process ids of the host's children."""
        wait_for(lambda: len(self.log) > 10, "the arm has setpoints")
        tasks = Path(f"/proc/{self.host.pid}/task")
        self.children = [int(pid) for each in tasks.glob("*/children") for pid in each.read_text().split()]
        (self.control,) = (
            pid for pid in self.children if b"ibrobot_core.control.process" in Path(f"/proc/{pid}/cmdline").read_bytes()
        )

    def kill_host(self) -> tuple[int, int]:
        """Kill the host; returns when it still lived and when it was dead [ns]."""
        alive_ns = time.monotonic_ns()
        self.host.kill()
        self.host.wait(PATIENCE_S)
        return alive_ns, time.monotonic_ns()

    def end(self) -> tuple[int, str]:
        """Wait for the host to exit; its status and standard error."""
        status = self.host.wait(PATIENCE_S)
        wait_for(lambda: not is_alive(self.control), "the control process exits")
        return status, self.errors()


@contextmanager
def logged_runs(site: Site, folder: Path) -> Iterator[Callable[..., Run]]:
    """Launches runs in a folder; ends those that are left."""
    site.add("ibrobot-plugin-logged", "logged_parts.py")
    (folder / "mini.yaml").write_text(ROBOT)
    runs: list[Run] = []

    def start(
        *overrides: str, mode: str = "teleop", awaited: bool = True, output: IO[bytes] | int | None = None
    ) -> Run:
        command = [sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "launch", "mini.yaml"]
        command += ["--headless", "--mode", mode, *(word for each in overrides for word in ("--set", each))]
        # Files and no pipes: these stay open as long as any child lives.
        with (folder / "output.txt").open("w") as out, (folder / "errors.txt").open("w") as errors:
            given: Any = {"stdout": out, "stderr": errors} if output is None else {"stdout": output, "stderr": output}
            host = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, **given)
        run = Run(folder, host)
        runs.append(run)
        if awaited:
            wait_for(lambda: run.is_swinging() or host.poll() is not None, "the arm swings", run.errors)
            assert host.poll() is None, f"the run ended: {run.errors()}"
            run.find_control()
        return run

    try:
        yield start
    finally:
        for run in runs:
            for pid in (run.host.pid, *run.children):
                with suppress(ProcessLookupError):
                    if is_alive(pid):
                        os.kill(pid, signal.SIGKILL)
            run.host.wait()


def errors_in(error: str) -> list[str]:
    return [line for line in error.splitlines() if line.startswith("error: ")]
