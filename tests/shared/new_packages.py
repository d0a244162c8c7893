"""Packages of `ibrobot plugins new`, as if they were installed, for their tests and runs."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import attrs
from ibrobot_kit.new import SAMPLE, NewPlugin
from ibrobot_testing import ibrobot_command

from ibrobot_core.app import installed_plugins


def sample_kinds(*packages: str, without: Iterable[str] = ()) -> list[str]:
    """The kinds whose samples are in these packages, or in all but those of `without`."""
    registry = installed_plugins()
    owners = {kind: registry.entries[SAMPLE, kind].package for kind in registry.types(SAMPLE)}
    return [kind for kind, owner in owners.items() if owner in packages or (not packages and owner not in without)]


@attrs.frozen
class NewPackages:
    """A package of each kind in a folder."""

    folder: Path
    kinds: tuple[str, ...]

    @classmethod
    def of(cls, folder: Path, kinds: Iterable[str]) -> NewPackages:
        """Make them, with the metadata that `pip install -e` would write."""
        made = cls(folder, tuple(kinds))
        for kind in made.kinds:
            package = Path(NewPlugin(kind, f"my_{kind}", folder)()["folder"])
            metadata = package / f"ibrobot_my_{kind}-0.1.0.dist-info"
            metadata.mkdir()
            (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package.name}\nVersion: 0.1.0\n")
            (metadata / "entry_points.txt").write_text(f"[ibrobot]\nmy_{kind} = ibrobot_my_{kind}\n")
        return made

    def place(self, kind: str) -> Path:
        """The folder of a package."""
        return self.folder / f"ibrobot-plugin-my-{kind.replace('_', '-')}"

    def robot(self, kind: str) -> Path:
        """Its robot YAML."""
        (robot,) = self.place(kind).rglob(f"my_{kind}.yaml")
        return robot

    def _run(self, command: Sequence[str], folder: Path, kinds: Iterable[str]) -> subprocess.CompletedProcess[str]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(self.place(kind)) for kind in kinds)}
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)

    def tests(self, kinds: Iterable[str]) -> subprocess.CompletedProcess[str]:
        """Run the tests of packages that can stand beside one another."""
        kinds = tuple(kinds)
        options = ("-q", "-p", "no:cacheprovider", "--import-mode=importlib")
        tests = (str(self.place(kind) / "tests") for kind in kinds)
        return self._run([sys.executable, "-m", "pytest", *options, *tests], self.folder, kinds)

    def launch(self, kind: str, *options: str) -> subprocess.CompletedProcess[str]:
        """Run the command that stands at the top of its robot YAML."""
        first = self.robot(kind).read_text(encoding="utf-8").partition("\n")[0]
        ((line,),) = [re.findall(r": ibrobot (.*)$", first)]
        return self._run([*ibrobot_command(), *shlex.split(line), *options], self.place(kind), [kind])
