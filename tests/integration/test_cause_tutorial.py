"""The cause of the tutorial: its own tests pass, and the diagnosis tests it beside the others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from ibrobot_diagnose.cause import KIND, Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.testing import make_window

from ibrobot_core.plugins import Entry, Registry

pytestmark = pytest.mark.integration

EXAMPLE = Path(__file__).parents[1] / "examples/ibrobot-plugin-to-and-fro"
MEASURED = "window.commands[np.isfinite(window.commands).all(axis=1)]"


def copied(folder: Path) -> Path:
    """The modules and tests of the tutorial."""
    for file in EXAMPLE.rglob("*.py"):
        target = folder / file.relative_to(EXAMPLE)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(file.read_text())
    return folder


def run_tests(folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--rootdir={folder}", "tests"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_its_tests_pass(tmp_path: Path) -> None:
    done = run_tests(copied(tmp_path))
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


def test_its_tests_find_the_mistake_of_which_the_tutorial_warns(tmp_path: Path) -> None:
    cause = copied(tmp_path) / "ibrobot_to_and_fro/cause.py"
    text = cause.read_text()
    assert MEASURED in text
    cause.write_text(text.replace(MEASURED, "np.nan_to_num(window.commands)"))
    done = run_tests(tmp_path)
    assert done.returncode == 1
    assert "with readings left out accuses it" in done.stdout


def test_diagnosis_tests_it_beside_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from ibrobot_to_and_fro import ibrobot_causes

    offered = {
        (KIND, each.type): Entry(KIND, each, "to_and_fro", "ibrobot-plugin-to-and-fro", "0.1.0")
        for each in ibrobot_causes()
    }
    monkeypatch.setattr("ibrobot_diagnose.diagnosis.installed_plugins", lambda: Registry(offered, []))
    times = np.arange(120) / 30
    window = make_window(0.2 * np.sin(10 * np.pi * times)[:, np.newaxis])
    assert "to_and_fro" in {each.name for each in diagnose(window, Reference()).findings}
