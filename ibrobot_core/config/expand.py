"""Expansion of values: `${ENV:default}`, `~/` and `package://PACKAGE/path`."""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from pathlib import Path

from ibrobot_core.errors import how_to_install

VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)(?::([^}]*))?\}")
"""A variable in a value of a robot YAML: its name, and its default."""


def expand(text: str) -> str:
    """`text` with `${ENV:default}` replaced by the environment's value and a leading `~/` by the home directory.

    Raises:
        ValueError: for an unset variable without a default, or a malformed `${`.
    """

    def replace(match: re.Match[str]) -> str:
        name, default = match.groups()
        if (value := os.environ.get(name, default)) is None:
            raise ValueError(f"environment variable {name} is not set; set it, or give a default: ${{{name}:value}}")
        return value

    if "${" in VARIABLE.sub("", text):
        raise ValueError(f"malformed variable in {text!r}; write ${{NAME}} or ${{NAME:default}}")
    expanded = VARIABLE.sub(replace, text)
    return str(Path(expanded).expanduser()) if expanded.startswith("~/") else expanded


def missing_package(text: str) -> str | None:
    """The package to install for a path `package://PACKAGE/path`; None if it is installed, or for any other path."""
    if not text.startswith("package://"):
        return None
    package = text.removeprefix("package://").partition("/")[0]
    return package.replace("_", "-") if package.isidentifier() and find_spec(package) is None else None


def resolve_path(text: str, base: Path) -> Path:
    """Resolve a path from a config: `package://PACKAGE/path` in an installed package, a relative path from `base`.

    Packages are located without importing them.

    Raises:
        ValueError: if the package is not installed or has no such file.
    """
    if not text.startswith("package://"):
        return base / text
    package, _, inside = text.removeprefix("package://").partition("/")
    if not package.isidentifier() or not inside or ".." in Path(inside).parts:
        raise ValueError(f"expected package://PACKAGE/path, got {text!r}")
    spec = find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        distribution = package.replace("_", "-")
        raise ValueError(f"the Python package {package!r} is not installed: {how_to_install(distribution)}")
    path = Path(next(iter(spec.submodule_search_locations))) / inside
    if not path.exists():
        raise ValueError(f"the Python package {package!r} has no file {inside!r}; check its version and the path")
    return path
