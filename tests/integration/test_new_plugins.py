"""`ibrobot plugins new` for the kinds that plugins define; test_kit.py of ibrobot-testing has those of core."""

from __future__ import annotations

import tomllib

import pytest
from ibrobot_kit.new import SAMPLE, NewPlugin
from new_packages import NewPackages, sample_kinds

from ibrobot_core.app import installed_plugins

pytestmark = pytest.mark.integration

KINDS = [*sample_kinds(without=("ibrobot-testing",)), "message"]
"""`message` is core's, and its tests need another package of this repository."""


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> NewPackages:
    return NewPackages.of(tmp_path_factory.mktemp("packages"), KINDS)


def test_every_kind_has_a_sample() -> None:
    registry = installed_plugins()
    samples = set(registry.types(SAMPLE))
    assert set(registry.all_kinds) - {SAMPLE} <= samples
    listed = (NewPlugin.__doc__ or "").partition("KIND is ")[2].partition(". ")[0]
    assert set(listed.replace(" or ", ", ").replace("\n", " ").replace(" ", "").split(",")) == samples, (
        "as its help says"
    )


def test_tests_of_new_packages_pass(packages: NewPackages) -> None:
    done = packages.tests(KINDS)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    "kind", [kind if kind == "planner" else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS]
)
def test_robot_of_a_new_package_runs(packages: NewPackages, kind: str) -> None:
    done = packages.launch(kind, "--lockstep")
    assert done.returncode == 0, done.stderr
    assert "faults     none" in done.stdout


@pytest.mark.parametrize(("kind", "needed"), [("planner", "ibrobot-plugin-planning"), ("pool", "ibrobot-provenance")])
def test_package_needs_the_one_that_defines_its_kind(packages: NewPackages, kind: str, needed: str) -> None:
    project = tomllib.loads((packages.place(kind) / "pyproject.toml").read_text())["project"]
    assert f"{needed}>=0.1,<0.2" in project["dependencies"]


def test_lines_fit(packages: NewPackages) -> None:
    """They have the width that the linter of the package permits."""
    files = [file for kind in KINDS for file in packages.place(kind).rglob("*.py")]
    wide = [f"{file.name}: {line}" for file in files for line in file.read_text().splitlines() if len(line) > 120]
    assert files
    assert wide == []
