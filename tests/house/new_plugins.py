"""Each kind of `ibrobot plugins new`, as an author meets it: from an empty environment to its own wheel.

    python tests/house/new_plugins.py WHEELS FOLDER [KIND …]

WHEELS has the wheels of this repository; environments and packages land in FOLDER. Prints a table of lines and seconds,
and exits with 1 if anything failed; what it printed then stands above the table.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
OFFICIAL = ROOT / "ibrobot_core/official_plugins.json"
STEPS = ("generate", "install", "tests", "lint", "types", "run", "wheel")


def sample_packages() -> dict[str, list[str]]:
    """Package -> the kinds whose samples it has."""
    offers: dict[str, dict[str, list[str]]] = json.loads(OFFICIAL.read_text(encoding="utf-8"))
    return {package: each["sample"] for package, each in offers.items() if "sample" in each}


def lines(folder: Path) -> int:
    """The lines of Python of a package, without empty ones and its tests."""
    files = folder.glob("ibrobot_*/*.py")
    return sum(bool(line.strip()) for file in files for line in file.read_text(encoding="utf-8").splitlines())


class Authors:
    """Authors, each with an empty folder and an empty environment in the same place."""

    def __init__(self, wheels: Path, folder: Path) -> None:
        self._wheels, self._folder = wheels, folder
        self._kit = folder / "kit"
        self._environment = folder / "environment"
        names = {path.name.partition("-")[0].replace("_", "-") for path in wheels.glob("*.whl")}
        # Wheels of an earlier run have the same names.
        self._fresh = [f"--refresh-package={name}" for name in sorted(names)]

    def _install(self, environment: Path, *wanted: str) -> list[str]:
        subprocess.run(["uv", "venv", "--quiet", "--clear", "--python", "3.12", environment], check=True)
        found = ("--find-links", self._wheels, "-c", ROOT / "constraints.txt")
        python = ("--python", environment / "bin/python")
        return [*map(str, ("uv", "pip", "install", "--quiet", *python, *found)), *self._fresh, *wanted]

    def set_up(self) -> None:
        """Install what generates packages."""
        subprocess.run(self._install(self._kit, *sample_packages()), check=True)

    def steps(self, kind: str) -> Iterator[tuple[str, Sequence[Sequence[str]], Path]]:
        """The steps of a kind: name, commands, and the folder in which they run."""
        name = f"my_{kind}"
        package = self._folder / "packages" / f"ibrobot-plugin-my-{kind.replace('_', '-')}"
        kit, own = self._kit / "bin", self._environment / "bin"
        yield "generate", [[f"{kit}/ibrobot", "plugins", "new", kind, name, "--out", str(package.parent)]], self._folder
        yield "install", [self._install(self._environment, f"{package}[test,lint]")], package
        yield "tests", [[f"{own}/python", "-m", "pytest", "-q", "-p", "no:cacheprovider"]], package
        yield "lint", [[f"{own}/ruff", "check", "-q", "."], [f"{own}/ruff", "format", "--check", "-q", "."]], package
        cache = f"--cache-dir={self._folder / 'mypy'}"
        yield "types", [[f"{own}/mypy", cache, "--python-executable", f"{own}/python"]], package
        (robot,) = [*package.glob(f"{name}.yaml"), *package.glob(f"*/{name}.yaml")]
        first = robot.read_text(encoding="utf-8").partition("\n")[0]
        command = shlex.split(re.findall(r": ibrobot (.*)$", first)[0])
        yield "run", [[f"{own}/ibrobot", *command]], package
        # As docs/how-to/publish-a-plugin.md says: the wheel alone, without what its tests need.
        built = ["uv", "build", "--quiet", "--wheel", "--clear"]
        wheel = f"{package}/dist/{package.name.replace('-', '_')}-0.1.0-py3-none-any.whl"
        installed = self._install(self._environment, wheel, "ibrobot-testing")
        yield "wheel", [built, installed, [f"{own}/ibrobot", "plugins", "check", package.name]], package

    def measure(self, kind: str) -> tuple[dict[str, float], int]:
        """The seconds of each step, up to the one that fails; and the lines of the package."""
        took: dict[str, float] = {}
        environment = {key: value for key, value in os.environ.items() if key not in ("VIRTUAL_ENV", "PYTHONPATH")}
        for step, commands, folder in self.steps(kind):
            begun = time.monotonic()
            for command in commands:
                done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
                if done.returncode:
                    print(f"{kind}: {step} failed: {shlex.join(command)}\n{done.stdout}{done.stderr}", flush=True)
                    return took, 0
            took[step] = time.monotonic() - begun
        return took, lines(folder)


def main(wheels: Path, folder: Path, *kinds: str) -> int:
    """Measure kinds, all by default; returns the exit status."""
    authors = Authors(wheels, folder)
    authors.set_up()
    known = sorted(kind for each in sample_packages().values() for kind in each)
    if unknown := sorted(set(kinds) - set(known)):
        print(f"there is no kind {unknown[0]}; there are: {', '.join(known)}")
        return 2
    print(f"{'kind':12} {'lines':>5} " + " ".join(f"{step:>8}" for step in STEPS), flush=True)
    failed = 0
    for kind in kinds or known:
        took, count = authors.measure(kind)
        cells = (f"{took[step]:7.1f}s" if step in took else f"{'failed':>8}" for step in STEPS)
        print(f"{kind:12} {count:5} " + " ".join(cells), flush=True)
        failed += len(took) < len(STEPS)
    print(f"{len(kinds or known) - failed} of {len(kinds or known)} kinds work")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).absolute(), Path(sys.argv[2]).absolute(), *sys.argv[3:]))
