"""The scheduling classes of the threads of a run, as `tests/shared/thread_classes.py` finds them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.integration
PROGRAM = Path(__file__).parents[2] / "tests/shared/thread_classes.py"
URGENT = "RR RESET"


@pytest.fixture(scope="module")
def permitted() -> None:
    """Real-time priority; tests that ask for it are skipped where the machine refuses it."""
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except PermissionError:
        pytest.skip("this machine permits no real-time priority")
    os.sched_setscheduler(0, policy, param)


@pytest.mark.parametrize(
    ("arguments", "urgent"),
    [
        (
            ("launch", "so101", "--duration", "2"),
            {"control link", "sensor:top", "sensor:wrist", "mode:model_inference", "status", "tool_pose"},
        ),
        (
            ("launch", "so101_blind", "--mode", "moveit_planning", "--goal", "rest", "--goal", "home"),
            {"control link", "status", "tool_pose"},
        ),
        (
            ("record", "so101_blind", "--episodes", "1", "--auto", "--set", "contract.max_duration_s=2"),
            {"control link", "mode:model_inference", "status", "tool_pose", "recording"},
        ),
    ],
    ids=["policy", "planning", "recording"],
)
@pytest.mark.usefixtures("permitted", "rendering")
def test_only_threads_with_short_work_have_real_time_priority(
    arguments: tuple[str, ...], urgent: set[str], tmp_path: Path
) -> None:
    command = [sys.executable, str(PROGRAM), *arguments, "--sim", "--headless"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    threads = json.loads(ran.stdout[ran.stdout.index("\n{") :])
    assert {name for name, classes in threads.items() if URGENT in classes} == urgent, ran.stderr
    ours = {name: set(classes) for name, classes in threads.items() if "process" not in name and name not in urgent}
    assert all(classes <= {"OTHER", "BATCH"} for classes in ours.values()), ours
    assert "MainThread" in ours
