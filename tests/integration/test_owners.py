"""Commands at once on one episode or dataset, and killed: a few of what `tests/shared/owners.py` runs twenty times."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration

PROGRAM = Path(__file__).parents[2] / "tests/shared/owners.py"
LONG = [pytest.param(name, marks=pytest.mark.long) for name in ("append", "train")]


@pytest.mark.parametrize("name", ["trim", *LONG])
def test_nothing_is_lost_or_doubled_and_refusals_name_the_owner(name: str) -> None:
    command = [sys.executable, str(PROGRAM), "--times", "1", "--kills", "1", "--only", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(" times: kept ") == 11, "ten pairs, and the killed ones"
