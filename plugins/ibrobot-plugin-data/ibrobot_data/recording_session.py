"""Options of `ibrobot record` besides those of every run, and the events that it prints."""

from __future__ import annotations

from pathlib import Path
from typing import Any, override

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import Event, Shown
from ibrobot_data.plural import plural
from ibrobot_data.prompt import check_prompt

CUES = ("beep", "speech", "none")
"""Kinds of cues; see `Cues`."""


@attrs.frozen(kw_only=True)
class RecordOptions:
    """Which episodes are recorded, and where."""

    prompt: str | None = option(
        None,
        validator=attrs.validators.optional(lambda _, __, prompt: check_prompt(prompt)),
        label="Task",
        help="description of the task, e.g. pick the cube; keys ask for it if left out",
    )
    dataset: str | None = option(None, label="Dataset", help="name of the dataset, a folder of episodes below the root")
    root: Path | None = option(None, label=None, help="folder of all datasets")
    episodes: int | None = option(
        None, ge=1, label="Episodes", help="number of episodes after which the session ends; without one, it goes on"
    )
    resume: bool = option(
        False,
        label="Go on",
        more=True,
        help="count the dataset's episodes of earlier runs, and keep their last prompt unless --prompt gives another",
    )
    cues: str = option(
        "beep",
        choices=CUES,
        label=None,
        help="what is heard when an episode begins, ends in three seconds, and is saved: bells of the terminal, or "
        "words by spd-say, say or espeak",
    )
    auto: bool = option(
        False,
        label="Automatic",
        more=True,
        help="begin episodes automatically; end them after contract.max_duration_s",
    )
    continuous: bool = option(
        False, label="Without a break", more=True, help="record one episode, from the start of the run to its end"
    )
    reset_time: float = option(0.0, ge=0, unit="s", label="Pause", more=True, help="pause between episodes")


@attrs.frozen(kw_only=True)
class Session(Event):
    """The state of a recording session."""

    folder: str = option(help="folder of the dataset")
    saved: int = option(help="episodes saved so far")
    wanted: int | None = option(help="episodes after which it ends; null: it does not end by itself")
    state: str = option(help="what it does at present")

    @override
    def shown(self) -> Shown:
        count = f"{self.saved} {plural(self.saved, 'episode')}"
        progress = None
        if self.wanted is not None:
            count = f"{self.saved} of {self.wanted} {plural(self.wanted, 'episode')}"
            progress = min(1.0, self.saved / self.wanted)
        made: dict[str, Any] = {"episodes": self.folder} if self.saved else {}
        return Shown(f"{self.state} · {count} saved", progress, made=made)
