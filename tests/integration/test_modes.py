"""The other two ways to move the simulated SO-101: goals for the planner, and teleoperation by log and by keyboard."""

from __future__ import annotations

import fcntl
import itertools
import json
import os
import pty
import select
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from tests.integration.conftest import Log, Ran

pytestmark = pytest.mark.integration

PLANNING = ("--lockstep", "--mode", "moveit_planning")
REACHED = 0.03
"""Goal tolerance and sag [rad]."""
PATIENCE_S = 60.0


def test_named_goals_are_reached_one_after_the_other(recorded: Callable[..., tuple[Ran, list[Log]]]):
    ran, (log,) = recorded(*PLANNING, "--goal", "home", "--goal", "rest", "--goal", "home")
    assert ran.code == 0, ran.err
    assert [line for line in ran.err.splitlines() if line.startswith("I goal ")] == [
        "I goal home reached",
        "I goal rest reached",
        "I goal home reached",
    ]
    assert log.positions[-1] == pytest.approx(np.zeros(6), abs=REACHED)
    lift = log.joint("shoulder_lift")
    middle = len(lift) // 4 + int(np.argmin(lift[len(lift) // 4 :]))
    assert lift[middle] == pytest.approx(-1.57, abs=REACHED), "it was at rest in between"
    assert lift[: middle + 1].max() == pytest.approx(0.0, abs=REACHED), "and at home before"


def test_a_goal_joint_by_joint_moves_these_and_no_others(recorded: Callable[..., tuple[Ran, list[Log]]]):
    ran, (log,) = recorded(*PLANNING, "--goal", "wrist_flex=0.5,gripper=1.0")
    assert ran.code == 0, ran.err
    assert log.joint("wrist_flex")[-1] == pytest.approx(0.5, abs=REACHED)
    assert log.joint("gripper")[-1] == pytest.approx(1.0, abs=REACHED)
    for joint in ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_roll"):
        assert log.joint(joint) == pytest.approx(log.joint(joint)[0], abs=0.05), joint


@pytest.mark.parametrize("goal", ["wrist_flex=3.0", "gripper=9"])
def test_a_goal_outside_the_limits_is_reported_and_exit_code_3(
    recorded: Callable[..., tuple[Ran, list[Log]]], goal: str
):
    ran, (log,) = recorded(*PLANNING, "--goal", goal, "--goal", "shoulder_pan=0.3")
    assert ran.code == 3, ran.err
    assert ran.summary["goals_failed"] == 1
    joint = goal.partition("=")[0]
    assert f"E goal {goal} failed: " in ran.err
    assert joint in next(line for line in ran.err.splitlines() if "failed" in line).partition("failed:")[2]
    assert "I goal shoulder_pan=0.3 reached" in ran.err
    assert log.joint("shoulder_pan")[-1] == pytest.approx(0.3, abs=REACHED)
    assert log.joint(joint) == pytest.approx(log.joint(joint)[0], abs=0.05)


class Terminal:
    """`ibrobot launch` in a terminal of its own, and a person at it."""

    def __init__(self, command: list[str], folder: Path) -> None:
        self.master, slave = pty.openpty()
        self.before = termios.tcgetattr(slave)
        self.slave = slave
        self.shown = ""
        self.process = subprocess.Popen(
            command,
            cwd=folder,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509 - so that Ctrl-C is a signal
        )

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def read(self, timeout_s: float) -> None:
        """Take in what is shown, waiting for something up to `timeout_s` [s]."""
        if select.select([self.master], [], [], timeout_s)[0]:
            with suppress(OSError):  # the other end is closed
                self.shown += os.read(self.master, 65536).decode(errors="replace")

    def until(self, done: Callable[[], bool], keys: str = "") -> None:
        """Type `keys` again and again, as a held key does, until `done`."""
        deadline = time.monotonic() + PATIENCE_S
        next_s = time.monotonic()
        pauses = itertools.chain((0.4,), itertools.repeat(0.033))  # before the first repeat, and between repeats
        while not done():
            assert time.monotonic() < deadline, self.shown[-3000:]
            assert self.process.poll() is None, self.shown[-3000:]
            if time.monotonic() >= next_s:
                self.type(keys)
                next_s = time.monotonic() + next(pauses)
            self.read(0.03)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def terminal(ibrobot: tuple[str, ...], tmp_path: Path) -> Iterator[Terminal]:
    recording = ("--set", "recording={type: joint_log, root: kept}")
    made = Terminal([*ibrobot, "launch", "so101_blind", "--sim", "--mode", "teleop", "--json", *recording], tmp_path)
    yield made
    made.close()


def test_a_person_jogs_by_keyboard_stops_and_leaves(terminal: Terminal, tmp_path: Path):
    path = tmp_path / "kept" / "default" / "episodes" / "episode_000001" / "joints.csv"

    def rows() -> list[list[float]]:
        text = path.read_text() if path.exists() else ""
        lines = text.rpartition("\n")[0].splitlines()[1:]  # a row may be half there
        return [[float(number) for number in line.split(",")[:-1]] for line in lines]  # without the checksum

    terminal.until(lambda: len(rows()) > 100)  # a key that is held while the mode begins does not count
    begun = rows()[0][1]
    terminal.until(lambda: abs(rows()[-1][1] - begun) > 0.3, keys="w")
    terminal.until(lambda: "EMERGENCY STOP" in terminal.shown, keys="\x1b")
    stopped = len(rows())
    terminal.until(lambda: len(rows()) > stopped + 150, keys="w")
    held = [row[1] for row in rows()[stopped + 50 :]]
    assert max(held) - min(held) < 0.01, "no key moves it after an emergency stop"

    terminal.type("\x03")
    deadline = time.monotonic() + PATIENCE_S
    while terminal.process.poll() is None:
        assert time.monotonic() < deadline, terminal.shown[-3000:]
        terminal.read(0.05)
    while "}\r\n" not in terminal.shown[terminal.shown.rfind("{") :]:  # what it said last may come after its end
        assert time.monotonic() < deadline, terminal.shown[-3000:]
        terminal.read(0.05)
    assert terminal.process.returncode == 1, terminal.shown[-3000:]  # an emergency stop
    assert termios.tcgetattr(terminal.slave) == terminal.before, "the terminal is as it was"
    last = terminal.shown.strip().splitlines()[-1]
    summary = json.loads(last[last.index("{") :])  # the terminal's cursor is shown again before it
    assert summary["faults"] == ["emergency stop"]
    assert summary["mode"] == "teleop"
