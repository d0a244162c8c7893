"""A recording process that is killed: everything up to a second before is there, without any repair."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import read, summary

CHILD = Path(__file__).parent / "recording_process.py"


def has_paused(stamps: list[int]) -> bool:
    """Whether a busy machine kept the process from running, and so from writing, in the last half second."""
    recent = [stamp_ns for stamp_ns in stamps if stamp_ns > stamps[-1] - 500_000_000]
    before = stamps[-len(recent) - 1 : -len(recent)]
    return any(b - a > 100_000_000 for a, b in itertools.pairwise([*before, *recent]))


@pytest.mark.parametrize(("compression", "count"), [("none", 530), ("lz4", 415), ("zstd", 7)])
def test_a_killed_recording_has_all_but_its_last_second(tmp_path, compression, count):
    path = tmp_path / "episode_000001"
    command = [sys.executable, str(CHILD), str(path), "300", compression]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        stamps = [int(child.stdout.readline()) for _ in range(count)]
        while has_paused(stamps):
            stamps.append(int(child.stdout.readline()))
        child.kill()
        stamps += [int(line) for line in child.stdout if line.endswith("\n")]
    found = read(path)
    assert [r.message.header.stamp_ns for r in found] == list(range(len(found)))
    assert [r.received_ns for r in found][: len(stamps)] == stamps[: len(found)]
    needed = [stamp_ns for stamp_ns in stamps if stamp_ns <= stamps[-1] - 1_000_000_000]
    assert len(found) >= len(needed)
    kept = summary(path)
    assert (kept.finished, dict(kept.metadata)) == (False, {"prompt": "pick"})
    assert sum(topic.count for topic in kept.topics.values()) == len(found)
