"""`ibrobot launch` as a user runs it: in a process of its own, with the simulated SO-101."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import chdir
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from command_line import run_here

from ibrobot_core.plugins import installed_plugins

collect_ignore_glob = [] if find_spec("ibrobot_feetech") else ["test_*.py"]  # without plugins nothing runs here
IBROBOT = (sys.executable, "-c", "from ibrobot_core.cli.main import main; main()")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


@attrs.frozen
class Ran:
    """What a run printed, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def summary(self) -> dict[str, Any]:
        """The last line of a run with `--json`."""
        summary = json.loads(self.out.splitlines()[-1])
        assert isinstance(summary, dict)
        return summary


@attrs.frozen
class Log:
    """A joint log: times [s] and positions [rad], shape (N, 6)."""

    times: np.ndarray
    positions: np.ndarray
    text: str

    @classmethod
    def read(cls, path: Path) -> Log:
        text = path.read_text()
        header, *rows = csv.reader(text.splitlines())
        assert tuple(header) == ("time_s", *JOINTS, "crc32")
        numbers = np.array([row[:-1] for row in rows], dtype=float)
        return cls(numbers[:, 0], numbers[:, 1:], text)

    def joint(self, name: str) -> np.ndarray:
        """Positions of one joint [rad], shape (N,)."""
        return self.positions[:, JOINTS.index(name)]


@pytest.fixture
def prompt_threads() -> Iterator[None]:
    """Threads of the tests' process give way soon: an emulated servo bus in one of them must answer in time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    yield
    sys.setswitchinterval(before)


@pytest.fixture(scope="session")
def rendering() -> None:
    """Simulated cameras; what asks for this is skipped on a machine that cannot render."""
    if (missing := installed_plugins().missing("sensor", "mujoco")) is not None:
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def first_conversion(tmp_path_factory: pytest.TempPathFactory) -> None:
    """It starts a process, and opens memory, that live as long as the interpreter."""
    from recordings import record  # where there are plugins

    folder = tmp_path_factory.mktemp("first")
    record(folder / "bag", 1, 0.3)
    assert run_here("convert", folder / "bag", "--out", folder / "set").returncode == 0


@pytest.fixture(scope="session")
def ibrobot() -> tuple[str, ...]:
    """The command `ibrobot`, of the interpreter that runs the tests."""
    return IBROBOT


@pytest.fixture
def launch(tmp_path: Path) -> Callable[..., Ran]:
    """Run `ibrobot launch so101_blind --sim --headless --json …` (without cameras) in a folder of its own.

    A run in lockstep is one of this process, which has imported already what each child would import again, unless
    `child` says otherwise.
    """

    def run(*arguments: str, robot: str = "so101_blind", child: bool = False) -> Ran:
        command = ["launch", robot, "--sim", "--headless", "--json", *arguments]
        if "--lockstep" in arguments and not child:
            with chdir(tmp_path):
                done = run_here(*command)
        else:
            done = subprocess.run(
                [*IBROBOT, *command], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
            )
        return Ran(done.returncode, done.stdout, done.stderr)

    return run


@pytest.fixture
def recorded(launch: Callable[..., Ran], tmp_path: Path) -> Callable[..., tuple[Ran, list[Log]]]:
    """As `launch`, with the joint log of each episode."""

    def run(*arguments: str, dataset: str = "default", child: bool = False) -> tuple[Ran, list[Log]]:
        recording = f"recording={{type: joint_log, root: kept, dataset: {dataset}}}"
        ran = launch("--set", recording, *arguments, child=child)
        folders = sorted((tmp_path / "kept" / dataset / "episodes").iterdir()) if ran.code in (0, 3) else []
        return ran, [Log.read(folder / "joints.csv") for folder in folders]

    return run
