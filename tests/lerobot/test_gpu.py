"""`benchmarks/gpu.py` on the CPU: its table has each kind of inference."""

from __future__ import annotations

import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import EVERYWHERE, act, save, statistics

pytestmark = [pytest.mark.lerobot, pytest.mark.long]

PROGRAM = Path(__file__).parents[2] / "benchmarks/gpu.py"


def test_table_has_each_precision_and_number_of_requests(tmp_path: Path) -> None:
    stats = statistics()
    for each in stats.values():
        each["std"][:] = 0.3  # what never changed would become too large for float16
    policy = str(save(act(**EVERYWHERE), tmp_path / "act", stats))
    command = [sys.executable, str(PROGRAM), policy, "--device", "cpu", "--at-once", "1", "2", "--rounds", "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = [line.strip("| ").split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")][1:]
    kinds = [
        *product(("here",), ("float32", "bfloat16", "float16"), "12"),
        *product(("ibrobot serve",), ("float32",), "12"),
    ]
    assert [tuple(row[:3]) for row in rows] == kinds
    for _, precision, _, *cells in rows:
        p50_ms, p99_ms, chunks_per_s, memory_mib, off_rad = map(float, cells)
        assert 0 < p50_ms <= p99_ms
        assert chunks_per_s > 0
        assert memory_mib > 100
        assert off_rad < (1e-5 if precision == "float32" else 0.1)
        assert precision == "float32" or off_rad > 1e-6, "half precision was not used"
