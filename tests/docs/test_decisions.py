"""Each decision says whether it holds, and since when; the workflow runs the README's commands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DECISIONS = sorted((ROOT / "docs/decisions").glob("0*.md"))


@pytest.mark.parametrize("page", DECISIONS, ids=lambda page: page.stem)
def test_a_decision_has_a_status_and_a_date(page: Path) -> None:
    _, _, third = page.read_text(encoding="utf-8").splitlines()[:3]
    status = r"(Accepted|Superseded by \[\d+\]\(\d{4}-[\w-]+\.md\))"
    assert re.fullmatch(rf"\*\*Status\.\*\* {status}, \d{{4}}-\d\d-\d\d\.", third)


def test_each_decision_has_a_number_of_its_own() -> None:
    numbers = [page.name[:4] for page in DECISIONS]
    assert numbers == sorted(set(numbers))
    assert all(page.read_text(encoding="utf-8").startswith(f"# {int(page.name[:4])}. ") for page in DECISIONS)


def test_the_workflow_runs_the_first_two_commands_of_the_readme() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    first, second = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")][:2]
    workflow = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))
    commands = [step["run"] for step in workflow["jobs"]["readme"]["steps"] if "run" in step]
    assert commands == [first, "bash .ci/run"]
    assert second in (ROOT / ".ci/run").read_text(encoding="utf-8")
