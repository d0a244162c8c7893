"""Checks the contracts of `imports.toml` for the packages that lie under plugins/.

python tests/house/lint_imports.py
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONTRACTS = Path(__file__).with_name("imports.toml")
NO_LIBRARIES = ("ibrobot_testing",)
"""Packages that plugins may not import."""


def contracts(plugins: Path) -> str:
    """The contracts for the distributions in a folder, as TOML.

    Plugins are `ibrobot-plugin-NAME`, and `lerobot-…`, which LeRobot discovers; the others are libraries.
    """
    of_plugins = [*packages_of(plugins, "ibrobot-plugin-*"), *packages_of(plugins, "lerobot-*")]
    libraries = [each for each in packages_of(plugins, "*") if each not in (*of_plugins, *NO_LIBRARIES)]
    text = CONTRACTS.read_text(encoding="utf-8")
    for mark, found in (("plugins", of_plugins), ("libraries", libraries)):
        text = text.replace(f'"{{{mark}}}"', ", ".join(f'"{each}"' for each in found))
    return text


def packages_of(plugins: Path, distributions: str) -> Iterator[str]:
    """The packages of some distributions in a folder."""
    yield from sorted(init.parent.name for init in plugins.glob(f"{distributions}/*ibrobot*/__init__.py"))


def main() -> int:
    """Run import-linter; returns its exit status."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "importlinter.toml"
        config.write_text(contracts(ROOT / "plugins"), encoding="utf-8")
        return subprocess.run(["lint-imports", "--config", str(config), "--no-cache"], cwd=ROOT, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
