"""All distributions have one version, set by one command."""

from __future__ import annotations

import re
import tomllib
from itertools import chain

import pytest
from set_version import pin, projects, version_of, with_version


def test_all_distributions_have_cores_version_and_its_pins() -> None:
    version = version_of(projects()[0])
    for path in projects():
        text = path.read_text(encoding="utf-8")
        assert with_version(text, version) == text, f"{path}: `python tests/house/set_version.py {version}` mends it"


@pytest.mark.parametrize(
    ("version", "wanted"), [("0.1.0", ">=0.1,<0.2"), ("0.2.3", ">=0.2,<0.3"), ("1.4.0", ">=1.4,<2")]
)
def test_pins_follow_semantic_versioning(version: str, wanted: str) -> None:
    assert pin(version) == wanted


def test_a_version_changes_nothing_but_itself_and_the_pins_of_these_packages() -> None:
    for path in projects():
        old, new = path.read_text(encoding="utf-8"), with_version(path.read_text(encoding="utf-8"), "7.8.9")
        found = tomllib.loads(new)["project"]
        assert found["version"] == "7.8.9"
        requirements = chain(found.get("dependencies", ()), *found.get("optional-dependencies", {}).values())
        # Extras of the same distribution, `ibrobot[sim]`, need no pin.
        ours = [each for each in requirements if re.match(r"ibrobot-|lerobot-env-ibrobot", each)]
        assert all(re.search(r">=7\.8,<8$", each) for each in ours), ours
        changed = [a for a, b in zip(old.splitlines(), new.splitlines(), strict=True) if a != b]
        assert all("ibrobot" in line or line.startswith("version = ") for line in changed), changed
