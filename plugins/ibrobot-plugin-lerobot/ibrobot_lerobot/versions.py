"""What is known of the versions of LeRobot: the one place of ibrobot where they stand.

`nox -s lerobot_versions` runs each of them against what these plugins read, write and run.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from packaging.version import InvalidVersion, Version

from ibrobot_core.api import Check, how_to_install

INSTALL = how_to_install("lerobot")
TESTED: Mapping[str, str] = {
    "0.4.4": "devices need `torch: true`, recording NumPy before 2.3; `ibrobot datasets push` and `pull` need a newer "
    "huggingface_hub than it allows",
    "0.5.1": "",
    "0.6.1": "",
}
"""Version that is tested, the newest of its minor one -> what is different with it."""


def installed() -> str | None:
    """The version of LeRobot in this environment; None if it is not installed."""
    if find_spec("lerobot") is None:
        return None
    try:
        return version("lerobot")
    except PackageNotFoundError:  # a folder without metadata
        return "of unknown version"


def tested(version: str) -> str | None:
    """The tested version with the same minor one as `version`; None if there is none."""
    try:
        minor = Version(version).release[:2]
    except InvalidVersion:
        return None
    return next((each for each in TESTED if Version(each).release[:2] == minor), None)


def untested(version: str) -> str:
    """A sentence on a version that is not tested; empty for the others."""
    if tested(version) is not None:
        return ""
    return f"LeRobot {version} is not one of the tested versions, {', '.join(TESTED)}"


def check() -> Check:
    """The line of `ibrobot doctor`."""
    name, version = "LeRobot's version", installed()
    if version is None:
        remedy = how_to_install("lerobot[dataset,training]")
        return Check(name, False, "not installed; training and policies need it", remedy, matters=False)
    alike = tested(version)
    if alike is None:
        return Check(name, False, f"{untested(version)}; it is tried nevertheless", INSTALL, matters=False)
    note = f"; {TESTED[alike]}" if TESTED[alike] else ""
    return Check(name, True, f"{version}, tested with {alike}{note}")
