"""Mutants of what `ibrobot plugins new` writes, by mutmut: which of them do the tests of each kind let pass?

    python tests/house/mutants.py FOLDER [KIND …]

The implementation of each package in FOLDER is mutated, and its tests run with each mutant. `surviving_mutants.yaml`
has a reason for each one that survives. Prints the counts of each kind; exits with 1 for a survivor without a reason.

Mutmut leaves functions with decorators alone, so `@override` is taken away first.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from ibrobot_kit.new import NewPlugin

from ibrobot_core.app import installed_plugins

REASONS = Path(__file__).with_name("surviving_mutants.yaml")
_SURVIVED, _UNTESTED = 0, 33
_CONFIG = """
[tool.mutmut]
source_paths = ["{module}/"]
only_mutate = ["{module}/{kind}.py"]
also_copy = ["."]
pytest_add_cli_args = ["-p", "no:cacheprovider", "-x"]
pytest_add_cli_args_test_selection = ["tests"]
timeout_constant = 20.0
use_git_change_detection = false
"""
_IMPATIENT = """
def pytest_collection_modifyitems(items):
    for item in items:
        if hasattr(item.cls, "wait_s"):
            item.cls.wait_s = 5.0
"""
"""What is right answers within a fraction of that, and every mutant that never answers takes as long."""
_ELSEWHERE = """
import pytest

@pytest.fixture(autouse=True)
def mutmut_is_configured(tmp_path):
    (tmp_path / "pyproject.toml").write_text('[tool.mutmut]\\nsource_paths = ["."]')
"""
"""Mutmut reads its configuration in every process, and those of a pool run in the folder of the test."""


def prepare(folder: Path, kind: str) -> Path:
    """A package of a kind, as mutmut takes it."""
    package = folder / f"ibrobot-plugin-my-{kind.replace('_', '-')}"
    shutil.rmtree(package, ignore_errors=True)
    NewPlugin(kind, f"my_{kind}", folder)()
    module = package / f"ibrobot_my_{kind}"
    file = module / f"{kind}.py"
    text = re.sub(r"^ +@override\n", "", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    file.write_text(text.replace("    from typing import override\n", ""), encoding="utf-8")
    settings = package / "pyproject.toml"
    text = settings.read_text(encoding="utf-8") + _CONFIG.format(module=module.name, kind=kind)
    settings.write_text(text, encoding="utf-8")
    (package / "conftest.py").write_text(_IMPATIENT + (_ELSEWHERE if kind == "pool" else ""), encoding="utf-8")
    if kind == "message":  # its tests encode one, for which the package has to be installed
        installed = package / f"{module.name}-0.1.0.dist-info"
        installed.mkdir()
        (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package.name}\nVersion: 0.1.0\n")
        (installed / "entry_points.txt").write_text(f"[ibrobot]\nmy_message = {module.name}\n")
    return package


def mutated(package: Path) -> tuple[Counter[int], list[str]]:
    """Run mutmut: exit code of the tests -> number of mutants, and the changes of those that survived."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "1"]
    ran = subprocess.run(command, cwd=package, capture_output=True, text=True, check=False)
    codes: dict[str, int] = {}
    results = [*package.glob("mutants/**/*.meta")]
    for file in results:
        codes |= json.loads(file.read_text(encoding="utf-8"))["exit_code_by_key"]
    if results and not codes:  # a class of data: it has no functions
        return Counter(), []
    if ran.returncode or not codes or None in codes.values():
        raise SystemExit(f"{package.name}: mutmut failed:\n{ran.stdout[-3000:]}\n{ran.stderr[-3000:]}")
    changes = [
        change for name, code in codes.items() if code in (_SURVIVED, _UNTESTED) for change in shown(package, name)
    ]
    return Counter(codes.values()), changes


def shown(package: Path, name: str) -> Iterator[str]:
    """The change of a mutant: the lines that went, `=>`, and those that came."""
    command = [sys.executable, "-m", "mutmut", "show", name]
    text = subprocess.run(command, cwd=package, capture_output=True, text=True, check=True).stdout
    went, came = (
        " ".join(
            line[1:].strip() for line in text.splitlines() if line.startswith(sign) and not line.startswith(3 * sign)
        )
        for sign in "-+"
    )
    yield f"{went} => {came}"


def reason_for(kind: str, change: str, reasons: list[dict[str, Any]]) -> str | None:
    """Why a mutant survives."""
    for each in reasons:
        if kind in each.get("kinds", [kind]) and re.search(each["change"], change):
            each["used"] = True
            return str(each["reason"])
    return None


def main(folder: Path, *kinds: str) -> int:
    """Mutate kinds, all by default; returns the exit status."""
    reasons: list[dict[str, Any]] = yaml.safe_load(REASONS.read_text(encoding="utf-8"))
    registry = installed_plugins()
    unexplained = 0
    print(f"{'kind':12} {'mutants':>7} {'killed':>7} {'late':>5} {'left':>5} {'seconds':>8}", flush=True)
    for kind in kinds or registry.types("sample"):
        begun = time.monotonic()
        codes, changes = mutated(prepare(folder, kind))
        late = sum(count for code, count in codes.items() if code in (36, 24, -24, 152))
        killed = codes.total() - len(changes) - late
        took = time.monotonic() - begun
        print(f"{kind:12} {codes.total():7} {killed:7} {late:5} {len(changes):5} {took:7.1f}s", flush=True)
        for change in changes:
            if reason_for(kind, change, reasons) is None:
                unexplained += 1
                print(f"    no reason: {change}", flush=True)
    if not kinds:
        for each in reasons:
            if "used" not in each:
                unexplained += 1
                print(f"no mutant survives for this reason, so remove it: {each['change']}")
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).absolute(), *sys.argv[2:]))
