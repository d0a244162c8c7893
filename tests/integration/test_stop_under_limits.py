"""Stops while the system is short of something: for each limit one run of `tests/shared/stop_under_limits.py`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

PROGRAM = Path(__file__).parents[2] / "tests/shared/stop_under_limits.py"


LONG = [pytest.param(kind, marks=pytest.mark.long) for kind in ("memory", "threads")]


@pytest.mark.parametrize("kind", ["files", "disk", *LONG])
def test_a_stop_is_answered_or_the_run_has_ended(kind: str) -> None:
    command = [sys.executable, str(PROGRAM), "--runs", "1", "--floor", "0", "--kind", kind]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if "only root may mount" in done.stderr:
        pytest.skip("a full disk needs a tmpfs, which only root may mount")
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{kind:8}   1 runs: " in done.stdout, done.stdout + done.stderr
