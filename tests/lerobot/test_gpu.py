"""`benchmarks/gpu.py` in miniature, on the CPU: every stage runs, and its table has them all."""

from __future__ import annotations

import re
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest

pytestmark = [pytest.mark.lerobot, pytest.mark.long]  # other tests show each stage

PROGRAM = Path(__file__).parents[2] / "benchmarks/gpu.py"


def ran(work: Path) -> str:
    command = (sys.executable, PROGRAM, "--miniature", "--work", work)
    done = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def rows(table: str) -> list[list[str]]:
    """The cells of the table's lines below its heads."""
    lines = [line.strip("| ").split(" | ") for line in table.splitlines() if line.startswith("| ")]
    return [line for line in lines if line[0] not in ("stage", "ACT")]


def test_miniature_has_each_stage_and_each_kind_of_inference(tmp_path: Path) -> None:
    table = ran(tmp_path)
    assert table.startswith("cpu, ")
    assert (tmp_path / "table.md").read_text(encoding="utf-8") == table.removesuffix("\n")
    stages, inference = rows(table)[:5], rows(table)[5:]
    assert [(stage, text) for stage, text, _ in stages] == [
        ("recorded", "1 of 1 demonstrations succeeded"),
        ("converted", stages[1][1]),
        ("trained", stages[2][1]),
        ("evaluated", "0 of 1, 95 % interval 0 to 98 %"),
        ("inference", "below"),
    ]
    assert re.fullmatch(r"1 episodes, 1\d\d frames with two pictures each", stages[1][1])
    assert re.fullmatch(r"2 steps, [\d.]+ frames/s, loss [\d.]+", stages[2][1])
    kinds = [
        *product(("here",), ("float32", "bfloat16", "float16"), "12"),
        *product(("ibrobot serve",), ("float32",), "12"),
    ]
    assert [tuple(row[:3]) for row in inference] == kinds
    for _, precision, _, *cells in inference:
        p50_ms, p99_ms, chunks_per_s, memory_mib, off_rad = map(float, cells)
        assert 0 < p50_ms <= p99_ms
        assert chunks_per_s > 0
        assert memory_mib > 100
        assert off_rad < (1e-5 if precision == "float32" else 0.1)
        assert precision == "float32" or off_rad > 1e-6, "half precision was not used"
    again = ran(tmp_path)  # all stages have their result
    assert again == table
