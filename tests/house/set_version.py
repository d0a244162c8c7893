"""Sets the version of every distribution, and the pins with which they name one another: `set_version.py X.Y.Z`."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
_VERSION = re.compile(r'(?m)^version = "(?P<version>[^"]*)"$')
_PIN = re.compile(r'"(?P<name>(?:lerobot-env-)?ibrobot[a-z0-9-]*(?:\[[a-z0-9,]*\])?)(?P<pin>[<>=~!][^";]*)')


def projects() -> list[Path]:
    """The `pyproject.toml` of every distribution, core's first, and those of the examples."""
    return [
        ROOT / "pyproject.toml",
        *sorted((ROOT / "plugins").glob("*/pyproject.toml")),
        *sorted((ROOT / "tests/examples").glob("*/pyproject.toml")),
    ]


def version_of(project: Path) -> str:
    """The version of a distribution."""
    found = _VERSION.search(project.read_text(encoding="utf-8"))
    if found is None:
        raise ValueError(f'{project}: no line `version = "X.Y.Z"`')
    return found["version"]


def pin(version: str) -> str:
    """What fits `version`: a plugin works with every later one whose API is compatible by semantic versioning."""
    major, minor, _ = map(int, version.split("."))
    return f">={major}.{minor},<{major + 1}" if major else f">=0.{minor},<0.{minor + 1}"


def with_version(text: str, version: str) -> str:
    """The text of a `pyproject.toml` with another version and the pins that fit it.

    Args:
        text: the text.
        version: `X.Y.Z`.
    """
    text = _VERSION.sub(f'version = "{version}"', text, count=1)
    return _PIN.sub(lambda match: f'"{match["name"]}{pin(version)}', text)


def main() -> int:
    """Change the files; returns the exit code."""
    version = sys.argv[1] if len(sys.argv) == 2 else ""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        print(f"the version is {version!r}, must be X.Y.Z, e.g. 0.2.0", file=sys.stderr)
        return 2
    for path in projects():
        path.write_text(with_version(path.read_text(encoding="utf-8"), version), encoding="utf-8")
    print(f"{version} in {len(projects())} files")
    return 0


if __name__ == "__main__":
    sys.exit(main())
