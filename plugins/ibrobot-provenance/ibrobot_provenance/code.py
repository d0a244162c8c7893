"""Versions of the installed packages that results depend on, and hashes of what can change without a new version."""

from __future__ import annotations

import hashlib
import itertools
import json
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from email.parser import HeaderParser
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import unquote, urlsplit

import attrs
from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

OPTIONAL = ("jax", "lerobot", "mujoco", "numpy", "onnxruntime", "ray", "torch")
"""Packages that plugins import if they are installed, without a requirement that says so."""
_SKIPPED = ("tests", "test", "docs", "build", "dist")
"""Folders beside an editable package's modules that are no part of it."""
_HASH_SIZE = 12


def installed_code(providers: Iterable[str]) -> dict[str, str]:
    """Versions of Python, of packages, and of all that these require, sorted by name.

    A package that is installed from a folder in editable mode has the hash of its source beside the version, which is
    read again with each call; one from an archive or a repository has the hash of its content or the commit.

    Args:
        providers: names of packages, e.g. those that provide plugins. Their optional requirements count too.
    """
    versions = dict[str, str]()
    optional = {canonicalize_name(name) for name in providers}
    todo = [*optional, *OPTIONAL]
    while todo:
        name = canonicalize_name(todo.pop())
        if name not in versions and (package := _package(name, tuple(sys.path))) is not None:
            source = f" (source {_source_hash(package.folder)})" if package.folder else ""
            versions[name] = f"{package.version}{source}"
            todo += package.requirements
            if name in optional:
                todo += package.optional
    return {"Python": platform.python_version(), **dict(sorted(versions.items()))}


def differing_code(wanted: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """Differences in words, e.g. `numpy 2.1.0, not 2.2.0`; empty if both are equal.

    Args:
        wanted: what it must be.
        here: what it is.
    """
    return [
        f"{name} {here.get(name, 'missing')}, not {wanted.get(name, 'installed')}"
        for name in sorted({*wanted, *here})
        if wanted.get(name) != here.get(name)
    ]


@attrs.frozen
class _Package:
    """An installed package."""

    version: str
    """Its version, with its commit or hash if it has one."""
    folder: Path | None
    """The folder of the source of an editable package."""
    requirements: tuple[str, ...]
    """Names of the packages that it requires here."""
    optional: tuple[str, ...]
    """Names of those that one of its extras requires."""


@cache
def _package(name: str, path: tuple[str, ...]) -> _Package | None:
    """An installed package, as long as the import path is the same; None if it is not installed."""
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return None
    # The head alone: the description below it is long, and parsing it is slow.
    head = HeaderParser().parsestr((package.read_text("METADATA") or "").partition("\n\n")[0])
    required: dict[str, list[str]] = {}
    extras = ["", *head.get_all("Provides-Extra", ())]
    for text in head.get_all("Requires-Dist", ()):
        try:
            each = Requirement(text)
        except InvalidRequirement:  # of an old package; pip has ignored it, too
            continue
        for extra in extras:
            if each.marker is None or each.marker.evaluate({"extra": extra}):
                required.setdefault(extra, []).append(each.name)
    optional = tuple(dict.fromkeys(itertools.chain(*required.values())))
    return _Package(*_origin(package), tuple(required.get("", ())), optional)


def _origin(package: Distribution) -> tuple[str, Path | None]:
    """The version of a package with its commit or hash, and the folder of an editable one."""
    version = package.version
    try:
        direct = json.loads(package.read_text("direct_url.json") or "{}")
    except ValueError:
        direct = {}
    if direct.get("dir_info", {}).get("editable"):
        return version, Path(unquote(urlsplit(direct["url"]).path))
    if commit := direct.get("vcs_info", {}).get("commit_id"):
        return f"{version} (commit {commit[:_HASH_SIZE]})", None
    if direct:
        digest = hashlib.sha256()
        for file in package.files or ():
            if file.hash is not None and not file.parts[0].endswith(".dist-info") and file.parts[0] != "..":
                digest.update(f"{file}\0{file.hash.value}\n".encode())
        return f"{version} (content {digest.hexdigest()[:_HASH_SIZE]})", None
    return version, None


def _source_hash(folder: Path) -> str:
    """Hash of the files of an editable package."""
    stats = ((path, path.stat()) for path in _sources(folder))
    return _hash_of(folder, tuple((path, stat.st_mtime_ns, stat.st_size) for path, stat in stats))


@cache
def _hash_of(folder: Path, files: tuple[tuple[Path, int, int], ...]) -> str:
    """Hash of files as they are now; their times and sizes tell when to read them again."""
    digest = hashlib.sha256()
    for path, _, size in files:
        digest.update(f"{path.relative_to(folder)}\0{size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:_HASH_SIZE]


def _sources(folder: Path) -> Iterator[Path]:
    """The files of an editable package, in order: those of `NAME/` and `src/NAME/`, or single modules beside."""
    tops = [top for top in (folder, folder / "src") if top.is_dir()]
    entries = [entry for top in tops for entry in sorted(top.iterdir()) if entry.name not in _SKIPPED]
    packages = [entry for entry in entries if (entry / "__init__.py").is_file()]
    if not packages:
        yield from (entry for entry in entries if entry.suffix == ".py" and entry.name != "setup.py")
    for package in packages:
        yield from sorted(each for each in package.rglob("*") if each.is_file() and "__pycache__" not in each.parts)
