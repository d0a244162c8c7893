"""Whole runs on a made-up arm that logs every command: what is left, and how the arm stops, however processes end."""

from __future__ import annotations

import os
import re
import signal
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from logged_run import PATIENCE_S, Run, errors_in, is_alive, logged_runs, wait_for

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

STOP_TICKS = 10
"""100 ms of the control loop. It brakes by ticks: those that a busy machine has it miss are none."""
REST, FAR = np.array([-1.2, 1.2]), np.array([-2.7, 2.7])


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


@pytest.fixture
def launch(site: Site, tmp_path: Path) -> Iterator[Callable[..., Run]]:
    with logged_runs(site, tmp_path) as start:
        yield start


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

        assert status == 130
        assert errors_in(error) == ["error: stopped"]

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

        assert status == 1  # an emergency stop
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
