"""The way from a STOP to the motors: what happens when a process or thread on it is stopped, blocked or killed.

docs/explanation/stopping.md has the table with the times.
"""

from __future__ import annotations

import fcntl
import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from logged_run import PATIENCE_S, Run, errors_in, is_alive, logged_runs, wait_for

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

LIMIT_S = 1.0
"""Longest motion after an event: `peer_timeout`, 0.3 s, and as much again for a busy machine."""


@pytest.fixture
def launch(site: Site, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    with logged_runs(site, tmp_path) as start:
        yield start


@pytest.fixture
def full_pipe() -> Iterator[tuple[int, int]]:
    """A pipe that takes no bytes: its reading and its writing end."""
    read, write = os.pipe()
    size = fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    os.write(write, b"x" * size)
    yield read, write
    os.close(read)
    os.close(write)


def motion_s(run: Run, since_ns: int) -> float:
    """How long the arm has moved since a time [s]."""
    moves = run.moves()
    return float(max(moves[-1] - since_ns, 0) * 1e-9)


def hold(run: Run) -> None:
    """Wait until the arm has had the same setpoint for half a second."""

    def holds() -> bool:
        times, _ = run.commands()
        return bool(times[-1] - run.moves()[-1] > 500_000_000)

    wait_for(holds, "the arm holds")


def end(run: Run) -> tuple[int, str]:
    run.host.send_signal(signal.SIGTERM)
    return run.end()


class TestHost:
    def test_stopped_by_sigstop_the_arm_holds_and_does_not_go_on(self, launch):
        run = launch("executors.arm_position.stale_timeout=60")
        stopped_ns = time.monotonic_ns()
        run.host.send_signal(signal.SIGSTOP)
        hold(run)
        assert motion_s(run, stopped_ns) < LIMIT_S
        before = run.commands()[1][-1]
        run.host.send_signal(signal.SIGCONT)
        wait_for(lambda: "fault" in run.errors(), "the run reports it")
        hold(run)

        np.testing.assert_array_equal(run.commands()[1][-1], before)
        _, error = end(run)
        assert re.search(rf"fault: the host process {run.host.pid} is stopped, and has been silent for \d+ ms", error)

    def test_suspended_by_ctrl_z_the_arm_holds_first(self, launch):
        run = launch()
        stopped_ns = time.monotonic_ns()
        run.host.send_signal(signal.SIGTSTP)
        wait_for(lambda: state_of(run.host.pid) == "T", "the host is suspended")

        assert motion_s(run, stopped_ns) < LIMIT_S
        run.host.send_signal(signal.SIGCONT)
        hold(run)
        _, error = end(run)
        assert "fault: the host was suspended by Ctrl-Z; the robot holds" in error


class TestControl:
    def test_stopped_by_sigstop_it_is_named_and_holds_when_it_goes_on(self, launch):
        run = launch()
        os.kill(run.control, signal.SIGSTOP)
        wait_for(lambda: "is stopped, and STOP does not reach the robot" in run.errors(), "the host names it")
        assert f"switch off the power of its motors, or `kill -CONT {run.control}` continues" in run.errors()
        os.kill(run.control, signal.SIGCONT)
        hold(run)

        status, error = end(run)
        assert "fault: the control loop has not run for" in error
        assert status == 1

    def test_stopped_by_sigstop_it_ends_with_the_run(self, launch):
        run = launch()
        os.kill(run.control, signal.SIGSTOP)
        wait_for(lambda: "is stopped, and STOP" in run.errors(), "the host names it")
        _, error = end(run)

        assert not is_alive(run.control)
        assert "killed" not in error

    def test_its_death_is_noticed_while_a_helper_holds_its_socket(self, launch):
        run = launch("hardware.fork=true")
        helper = int(Path(f"/proc/{run.control}/task/{run.control}/children").read_text())
        run.children.append(helper)
        os.kill(run.control, signal.SIGKILL)

        assert run.host.wait(PATIENCE_S) == 1
        assert errors_in(run.errors()) == ["error: control: the control process died (killed by SIGKILL)"]
        assert is_alive(helper)


class TestOutput:
    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_that_nobody_reads_does_not_keep_a_run_from_ending(self, launch, full_pipe, number):
        run = launch(output=full_pipe[1])
        time.sleep(2.5)  # it has tried to write a status line
        came_ns = time.monotonic_ns()
        run.host.send_signal(number)

        assert run.host.wait(PATIENCE_S) == 0
        assert motion_s(run, came_ns) < LIMIT_S
        wait_for(lambda: not is_alive(run.control), "the control process exits")

    def test_that_is_read_again_tells_what_was_lost(self, launch, full_pipe):
        read, write = full_pipe
        run = launch("teleoperation.swing.chatter=true", output=write)
        time.sleep(1.0)
        os.set_blocking(read, False)
        text = b""

        def read_on() -> bool:
            nonlocal text
            with suppress(BlockingIOError):
                text += os.read(read, 65536)
            return b"nothing read this output; messages dropped: " in text

        wait_for(read_on, "the loss is told")
        run.host.send_signal(signal.SIGTERM)
        wait_for(lambda: (read_on() or True) and run.host.poll() is not None, "the run ends")


class TestThreads:
    @pytest.mark.parametrize("how", ["raise", "exit"])
    def test_one_that_dies_ends_the_run_and_is_named(self, launch, how):
        run = launch(f"teleoperation.swing.thread={how}")
        status = run.host.wait(PATIENCE_S)

        assert status == 1
        [line] = errors_in(run.errors())
        assert line.startswith("error: thread 'swing helper': ")
        wait_for(lambda: not is_alive(run.control), "the control process exits")

    def test_teleop_that_blocks_ends_the_run_and_the_arm_holds_long_before(self, launch):
        run = launch("teleoperation.swing.trouble=block")
        status = run.host.wait(PATIENCE_S)

        times, _ = run.commands()
        assert status == 1
        assert errors_in(run.errors())[0] == (
            "error: teleop swing (swing): does not react for 6 s: STOP would be late there"
        )
        assert (times[-1] - run.moves()[-1]) * 1e-9 > 4.0

    def test_teleop_that_exits_ends_the_run(self, launch):
        run = launch("teleoperation.swing.trouble=exit")

        assert run.host.wait(PATIENCE_S) == 1
        assert errors_in(run.errors()) == [
            "error: mode:teleop: its thread was ended by SystemExit('a device ended it')"
        ]

    def test_the_main_thread_that_blocks_does_not_keep_ctrl_c_from_stopping_the_arm(self, launch):
        run = launch("teleoperation.swing.trouble=main")
        wait_for(lambda: "the main thread is blocked" in run.errors(), "the main thread is blocked")
        came_ns = time.monotonic_ns()
        run.host.send_signal(signal.SIGINT)
        hold(run)

        assert motion_s(run, came_ns) < 1.0 + LIMIT_S
        wait_for(
            lambda: "fault: the run ends, but its main thread is busy; the robot holds" in run.errors(), "it says so"
        )
        run.host.send_signal(signal.SIGINT)
        assert run.host.wait(PATIENCE_S) == 130
        wait_for(lambda: not is_alive(run.control), "the control process exits")

    def test_the_thread_that_takes_states_that_blocks_is_a_fault_for_control(self, launch):
        run = launch("control.stop=relax", "teleoperation.swing.trouble=link")
        wait_for(lambda: run.log[-1][0] == "relax", "control relaxes because of the fault")

        assert run.host.poll() is None
        run.host.kill()
        wait_for(lambda: not is_alive(run.control), "the control process exits")


def state_of(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
