"""Whole runs on a made-up arm that logs every command: what is left, and how the arm stops, however processes end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
import numpy as np
import pytest
from numpy.typing import NDArray

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

pytestmark = pytest.mark.integration

PATIENCE_S = 60.0
STOP_TICKS = 10
"""100 ms of the control loop. It brakes by ticks: those that a busy machine has it miss are none."""


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
REST, FAR = np.array([-1.2, 1.2]), np.array([-2.7, 2.7])


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE_S:.0f} s"
        time.sleep(0.005)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return pid > 0 and Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def memories(pids: list[int]) -> set[tuple[int, int]]:
    """Device and inode of each memory shared between host and control that these processes have open."""
    found = set()
    for pid in pids:
        with suppress(OSError):
            for entry in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):
                    if "memfd:ibrobot" in os.readlink(entry):
                        status = entry.stat()
                        found.add((status.st_dev, status.st_ino))
    return found


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
        return status, (self.folder / "errors.txt").read_text()


@pytest.fixture
def launch(site: Site, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    site.add("ibrobot-plugin-logged", "logged_parts.py")
    (tmp_path / "mini.yaml").write_text(ROBOT)
    runs: list[Run] = []

    def start(*overrides: str, mode: str = "teleop", awaited: bool = True) -> Run:
        command = [sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", "launch", "mini.yaml"]
        command += ["--headless", "--mode", mode, *(word for each in overrides for word in ("--set", each))]
        # Files and no pipes: these stay open as long as any child lives.
        with (tmp_path / "output.txt").open("w") as output, (tmp_path / "errors.txt").open("w") as errors:
            host = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        run = Run(tmp_path, host)
        runs.append(run)
        if awaited:
            wait_for(run.is_swinging, "the arm swings")
            run.find_control()
        return run

    yield start
    for run in runs:
        for pid in (run.host.pid, *run.children):
            with suppress(ProcessLookupError):
                if is_alive(pid):
                    os.kill(pid, signal.SIGKILL)
        run.host.wait()


def errors_in(error: str) -> list[str]:
    return [line for line in error.splitlines() if line.startswith("error: ")]


class TestKilledHost:
    def test_hold_stops_the_arm_within_100_ms(self, launch):
        run = launch()
        alive_ns, dead_ns = run.kill_host()
        wait_for(lambda: not is_alive(run.control), "the control process exits")

        moves = run.moves()
        assert moves[-1] > alive_ns  # the arm was moving
        assert (moves > dead_ns).sum() <= STOP_TICKS

    def test_relax_takes_torque_off_within_100_ms(self, launch):
        run = launch("control.stop=relax")
        alive_ns, dead_ns = run.kill_host()
        wait_for(lambda: not is_alive(run.control), "the control process exits")

        word, stamp_ns = run.log[-1]
        assert word == "relax"
        assert alive_ns < int(stamp_ns)
        assert (run.commands()[0] > dead_ns).sum() <= STOP_TICKS

    def test_pose_is_on_its_way_within_100_ms_and_reached(self, launch):
        run = launch("control.stop=pose rest")
        _, dead_ns = run.kill_host()
        wait_for(lambda: not is_alive(run.control), "the control process exits")

        times, positions = run.commands()
        distances = np.abs(positions - REST)[times > dead_ns][STOP_TICKS:]
        assert (np.diff(distances, axis=0) <= 1e-9).all()
        assert (np.diff(distances[:5], axis=0) < 0).all()
        np.testing.assert_allclose(positions[-1], REST, atol=1e-4)

    def test_a_child_of_the_host_that_lives_on_changes_nothing(self, launch):
        run = launch("teleoperation.swing.fork=true")
        _, dead_ns = run.kill_host()
        assert len(run.children) == 2
        wait_for(lambda: not is_alive(run.control), "the control process exits")

        assert (run.moves() > dead_ns).sum() <= STOP_TICKS

    @pytest.mark.parametrize("both", [False, True], ids=["host", "both"])
    def test_no_shared_memory_is_left(self, launch, both):
        run = launch()
        pids = [run.host.pid, run.control]
        shared = memories(pids)
        assert len(shared) == 1
        for pid in pids:  # nothing with a name, which could outlive them
            assert "/dev/shm" not in Path(f"/proc/{pid}/maps").read_text()
        if both:
            os.kill(run.control, signal.SIGKILL)
        run.kill_host()
        wait_for(lambda: not is_alive(run.control), "the control process exits")

        everybody = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()]
        assert not shared & memories(everybody)


DARK = "peripherals=[{name: top, kind: camera, type: dark}]"


class TestInterrupt:
    def test_while_a_sensor_is_awaited_stops_in_order(self, launch):
        run = launch(DARK, awaited=False)
        run.find_control()
        run.host.send_signal(signal.SIGINT)
        status, error = run.end()

        assert status == 0
        assert errors_in(error) == []

    def test_the_first_stops_in_order(self, launch):
        run = launch("control.stop=pose rest")
        run.host.send_signal(signal.SIGINT)
        status, error = run.end()

        assert status == 0
        assert errors_in(error) == []
        np.testing.assert_allclose(run.commands()[1][-1], REST, atol=1e-4)

    def test_the_second_ends_the_host_at_once_and_the_arm_brakes_on_its_way_to_the_pose(self, launch):
        run = launch("control.stop=pose far")
        run.host.send_signal(signal.SIGINT)
        count = len(run.log)
        wait_for(lambda: len(run.log) > count + 20, "the arm is on its way to the pose")
        run.host.send_signal(signal.SIGINT)

        assert run.host.wait(PATIENCE_S) == 130
        assert is_alive(run.control)
        wait_for(lambda: not is_alive(run.control), "the control process exits")
        commands = run.commands()[1]
        np.testing.assert_array_equal(commands[-1], commands[-2])
        assert np.abs(commands[-1] - FAR).max() > 0.1

    def test_a_second_sigterm_brakes_the_arm_on_its_way_to_the_pose_and_ends_in_order(self, launch):
        run = launch("control.stop=pose far")
        run.host.send_signal(signal.SIGTERM)
        count = len(run.log)
        wait_for(lambda: len(run.log) > count + 20, "the arm is on its way to the pose")
        run.host.send_signal(signal.SIGTERM)
        status, error = run.end()

        assert status == 0
        assert "emergency stop: the robot holds where it is, and the run ends" in error
        commands = run.commands()[1]
        np.testing.assert_array_equal(commands[-1], commands[-2])
        assert np.abs(commands[-1] - FAR).max() > 0.1


class TestDeath:
    def test_of_the_control_process_is_reported_on_one_line(self, launch):
        run = launch()
        os.kill(run.control, signal.SIGKILL)
        status, error = run.end()

        assert status == 1
        assert errors_in(error) == ["error: control: the control process died (killed by SIGKILL)"]

    def test_of_the_control_process_while_a_sensor_is_awaited_is_reported(self, launch):
        run = launch(DARK, awaited=False)
        run.find_control()
        os.kill(run.control, signal.SIGKILL)
        status, error = run.end()

        assert status == 1
        assert errors_in(error) == ["error: control: the control process died (killed by SIGKILL)"]

    def test_of_the_control_loop_by_a_bug_is_reported_on_one_line(self, launch):
        run = launch("hardware.trouble=true", awaited=False)
        status, error = run.end()

        assert status == 1
        [line] = errors_in(error)
        assert line.startswith(
            "error: control: the control process died (ZeroDivisionError: division by zero (a bug at "
        )

    def test_of_a_sensor_stops_the_robot(self, launch):
        run = launch("peripherals=[{name: top, kind: camera, type: brittle}]", "control.stop=pose rest", awaited=False)
        status, error = run.end()

        assert status == 1
        assert errors_in(error) == ["error: sensor:top: the camera was unplugged"]
        np.testing.assert_allclose(run.commands()[1][-1], REST, atol=1e-4)

    def test_of_a_policy_that_does_not_load_comes_before_anything_is_powered(self, launch):
        run = launch(mode="policy", awaited=False)
        status, error = run.end()

        assert status == 1
        assert [re.sub(r"^error: (model:lost: )?", "", line) for line in errors_in(error)] == [
            "no such checkpoint: lost.pt"
        ]
        assert run.log == []
