"""`ibrobot datasets card`."""

from __future__ import annotations

import json
from pathlib import Path

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import RequestError, echo, wrong_input
from ibrobot_diagnose.references import windows_of


@attrs.frozen(kw_only=True)
class MakeCard:
    """Make the card of DATASET, with which runs are compared.

    The card has the ranges of joints, actions and speeds, start poses, tasks, and small pictures of each camera.
    `ibrobot train` makes one beside each checkpoint.
    """

    dataset: Path = option(typed="DATASET", names="dataset", help="a LeRobot dataset, or a folder of recorded episodes")
    out: Path | None = option(None, help="file of the card; by default reference.json in the dataset")
    trained: str = option("", label=None, help="JSON of a training on it: policy, step, steps, batch_size, norm_mode")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_provenance.recorded_names import CARD

        from ibrobot_diagnose.card import make_card

        try:
            trained = json.loads(self.trained) if self.trained else None
        except ValueError as error:
            raise RequestError(f"--trained: is not JSON: {error}") from None
        card = make_card(windows_of(self.dataset), trained=trained)
        out = self.out or self.dataset / CARD
        card.write(out)
        echo(f"card of {counted(card.episodes, 'episode')}, {counted(card.frames, 'frame')} -> {out}", err=True)
