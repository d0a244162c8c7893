"""Everything on the servo buses fails in turn, for some seconds; the program itself runs ten minutes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]


def test_teleoperation_survives_every_fault_of_the_buses_without_unasked_motion() -> None:
    command = (sys.executable, ROOT / "tests/shared/feetech_faults.py", "--seconds", "8", "--pause", "0.4")
    ran = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, f"{ran.stdout}\n{ran.stderr}"
    seen = json.loads(ran.stdout)
    assert sum(seen["incidents"].values()) >= 2
    assert seen["resets"]["done"] >= 1
