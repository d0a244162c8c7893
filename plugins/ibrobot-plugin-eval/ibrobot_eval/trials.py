"""Blinded trials on a real arm: the sealed order of the policies, and the operator's judgements.

Trials come in blocks. In each block every policy has one trial, in random order, from the same start. The order is
sealed: until it is opened, no other file says which policy acted in which trial.
"""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np

from ibrobot_core.api import DatasetError
from ibrobot_eval.episodes import write
from ibrobot_eval.policies import as_texts

ORDER = "order.sealed"
OPENED = "order_opened.json"
SEALED = ".sealed"
"""Folder of the recordings until the order is opened, since they name the policy."""
SUCCESS, FAILURE, VOID = "success", "failure", "void"
OUTCOMES = (SUCCESS, FAILURE, VOID)


@attrs.frozen
class Trial:
    """A trial that the operator has judged."""

    number: int
    """Its number from 1, in the order of execution."""
    block: int
    """Number of the block, from 0."""
    place: int
    """Place within the block's order, from 0."""
    outcome: str
    reason: str
    """Why it is void; empty otherwise."""
    time_s: float
    """Time from its beginning to the operator's key, or to its end [s]."""
    interventions: dict[str, int]
    faults: tuple[str, ...] = attrs.field(converter=as_texts)
    seal: str
    """Hash of the sealed order under which it ran."""

    @classmethod
    def read(cls, file: Path) -> Trial:
        """Read a trial."""
        return cls(**json.loads(file.read_text(encoding="utf-8")))


class Order:
    """The sealed order of an evaluation's trials, and the trials so far.

    Args:
        out: the folder of the evaluation.
        labels: labels of the policies.

    Attributes:
        seal: hash of the sealed order.
        trials: the judged trials, in the order of execution.
    """

    def __init__(self, out: Path, labels: Sequence[str]) -> None:
        self._out = out
        self._labels = list(labels)
        file = out / ORDER
        if not file.exists():
            write(file, _sealed({"key": secrets.randbits(128), "policies": self._labels}))
        sealed = file.read_bytes()
        self.seal = hashlib.sha256(sealed).hexdigest()
        try:
            self._key = int(json.loads(zlib.decompress(base64.b85decode(sealed)))["key"])
        except (ValueError, KeyError, zlib.error) as error:
            raise DatasetError(f"{file}: the sealed order cannot be read: {error}") from None
        files = sorted((out / "trials").glob("trial_*.json"))
        self.trials = [Trial.read(each) for each in files]

    def _policy(self, block: int, place: int) -> str:
        order = np.random.default_rng((self._key, block)).permutation(len(self._labels))
        return self._labels[int(order[place])]

    def next(self) -> tuple[int, int, str]:
        """Block, place and policy of the next trial. A void trial is repeated at the end of its block."""
        judged = {(each.block, each.place) for each in self.trials if each.outcome != VOID}
        block = 0
        while all((block, place) in judged for place in range(len(self._labels))):
            block += 1
        tried = [each.place for each in self.of(block)]
        left = [place for place in range(len(self._labels)) if (block, place) not in judged]
        place = min(left, key=lambda each: (tried.count(each), each))
        return block, place, self._policy(block, place)

    def of(self, block: int) -> list[Trial]:
        """The trials of a block so far."""
        return [each for each in self.trials if each.block == block]

    @property
    def blocks(self) -> int:
        """Number of complete blocks."""
        return self.next()[0]

    def add(self, trial: Trial) -> None:
        """Store a judged trial.

        Raises:
            DatasetError: if the order has been opened.
        """
        self.check_sealed()
        write(self._out / "trials" / f"trial_{trial.number:04d}.json", json.dumps(attrs.asdict(trial), indent=1) + "\n")
        self.trials.append(trial)

    def check_sealed(self) -> None:
        """Refuse further trials once the order has been opened.

        Raises:
            DatasetError: if the order has been opened.
        """
        if (self._out / OPENED).exists():
            raise DatasetError(
                f"{self._out}: the order of the trials has been opened, so further ones would not be blind; "
                "begin another evaluation in a new folder"
            )

    def outcomes(self) -> dict[str, list[Trial]]:
        """Policy -> its trials of complete blocks. For decisions within the program; never show it."""
        complete = self.blocks
        by_label: dict[str, list[Trial]] = {label: [] for label in self._labels}
        judged = {(each.block, each.place): each for each in self.trials if each.outcome != VOID}
        for block in range(complete):
            for place in range(len(self._labels)):
                by_label[self._policy(block, place)].append(judged[block, place])
        return by_label

    def open(self) -> dict[str, list[Trial]]:
        """Open the order. No trial can follow. Returns policy -> its trials of complete blocks.

        Raises:
            DatasetError: if a trial was not blind: it ran under another order, or after the order was opened.
        """
        file = self._out / OPENED
        if wrong := [each.number for each in self.trials if each.seal != self.seal]:
            raise DatasetError(f"{self._out}: {_numbers(wrong)} not run under this sealed order, so they are not blind")
        opened = {"trials": len(self.trials), "seal": self.seal}
        if file.exists():
            known = json.loads(file.read_text(encoding="utf-8"))
            if known != opened:
                late = [each.number for each in self.trials[known["trials"] :]]
                raise DatasetError(
                    f"{self._out}: {_numbers(late)} run after the order was opened, so they are not blind"
                )
        else:
            write(file, json.dumps(opened, indent=1) + "\n")
        for recording in sorted((self._out / SEALED).glob("trial_*")):
            shown = self._out / "episodes" / recording.name
            shown.parent.mkdir(exist_ok=True)
            recording.rename(shown)
        return self.outcomes()


def _numbers(trials: Sequence[int]) -> str:
    names = ", ".join(map(str, trials)) or "some"
    return f"trial {names} was" if len(trials) == 1 else f"trials {names} were"


def _sealed(content: dict[str, Any]) -> bytes:
    """Encode so that nobody reads it by accident. It is a seal, not a secret."""
    return base64.b85encode(zlib.compress(json.dumps(content).encode()))
