"""The file `dataset.yaml` of a dataset, with its robot, contract and last prompt."""

from __future__ import annotations

from contextlib import closing, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import yaml
from ibrobot_provenance.files import replace_file
from ibrobot_provenance.ownership import Ownership, owned

from ibrobot_core.api import Contract, IbrobotError, RecorderError
from ibrobot_core.app import installed_plugins

_WAIT_S = 10.0
"""Time to wait for another process, which changes `dataset.yaml` within milliseconds."""


def count_complete(folder: Path) -> int:
    """Number of episodes of a dataset's folder that are complete, i.e. need no repair."""
    count = 0
    for path in sorted(folder.glob("episodes/episode_*")):
        with suppress(IbrobotError, OSError), closing(installed_plugins().open_episode(path)) as reader:
            count += reader.summary().finished
    return count


class EpisodeDataset:
    """A dataset of episodes in a folder.

    Args:
        folder: `ROOT/DATASET`; may be missing.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = folder / "dataset.yaml"

    @property
    def prompt(self) -> str:
        """The last prompt; empty if none was given.

        Raises:
            RecorderError: if `dataset.yaml` cannot be read.
        """
        return str(self._read().get("prompt", ""))

    @prompt.setter
    def prompt(self, prompt: str) -> None:
        with self._owned():
            self._write({**self._read(), "prompt": prompt})

    def join(self, contract: Contract, robot: str, robot_type: str) -> None:
        """Check that the dataset has this contract, and create `dataset.yaml` for the first episode.

        Args:
            contract: the contract of the new episode.
            robot: the name of the robot.
            robot_type: LeRobot's name for the type of robot.

        Raises:
            RecorderError: if the dataset has another contract, or the file cannot be written.
        """
        if "fingerprint" in self._read():
            self.check(contract)
            return
        facts = {"name": self._folder.name, "robot": robot, "robot_type": robot_type}
        with self._owned():
            self.check(contract)  # another run may have been the first
            described = {**facts, "fingerprint": contract.fingerprint(), "contract": contract.canonical()}
            self._write(described | self._read())

    def check(self, contract: Contract) -> None:
        """Check that the dataset has this contract, or no episodes.

        Raises:
            RecorderError: if it has another contract; shows the difference.
        """
        known = self._read()
        if known.get("fingerprint", contract.fingerprint()) != contract.fingerprint():
            difference = contract.difference(known.get("contract") or {}, names=("this run", "the dataset"))
            raise RecorderError(
                f"{self._file}: its episodes have another contract; record into another dataset "
                f"(recording.dataset), or change the contract back:\n{difference}"
            )

    def check_writable(self) -> None:
        """Check that the dataset's folder is writable, without leaving files.

        Raises:
            RecorderError: if it is not.
        """
        folder = next(path for path in (self._folder, *self._folder.absolute().parents) if path.exists())
        try:
            TemporaryFile(dir=folder).close()
        except OSError as error:
            raise RecorderError(
                f"recording.root: {self._folder} cannot be written: {folder}: {error.strerror}; choose another root"
            ) from None

    def _owned(self) -> Ownership:
        """Lock `dataset.yaml` for a change."""
        lock = self._folder / ".dataset.lock"
        return owned(self._file, "is being changed", RecorderError, file=lock, wait_s=_WAIT_S)

    def _read(self) -> dict[str, Any]:
        try:
            document = yaml.safe_load(self._file.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise RecorderError(f"{self._file}: cannot be read: {error}") from None
        if not isinstance(document, dict):
            raise RecorderError(f"{self._file}: must be a mapping, with name, robot, fingerprint and contract")
        return document

    def _write(self, facts: dict[str, Any]) -> None:
        try:
            replace_file(self._file, yaml.safe_dump(facts, sort_keys=False, allow_unicode=True))
        except OSError as error:
            raise RecorderError(f"{self._file}: cannot be written: {error.strerror}") from None
