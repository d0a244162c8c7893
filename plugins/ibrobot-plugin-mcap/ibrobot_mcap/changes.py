"""Options and events of the commands that change episodes; pages derive forms from them."""

from __future__ import annotations

from pathlib import Path
from typing import override

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import Event, Shown

OUTCOMES = {"success": "success", "failure": "failure", "unknown": "unknown"}
DELETED, TRIMMED, REPLACED = "deleted", "trimmed", "replaced"
DONE = {
    DELETED: "deleted",
    TRIMMED: "trimmed; this is the original",
    REPLACED: "replaced when a trim was undone",
}
"""What was done with an episode in the trash -> text for people."""


@attrs.frozen(kw_only=True)
class MarkOptions:
    """Outcomes of episodes."""

    episodes: tuple[Path, ...] = option(argument=True, names="episodes", help="episodes to judge")
    outcome: str = option(argument=True, choices=OUTCOMES, help="how they went")


@attrs.frozen(kw_only=True)
class TrimOptions:
    """The part of an episode to keep."""

    episode: Path = option(argument=True, names="episodes", help="the episode")
    begin_s: float = option(0.0, ge=0, unit="s", flag="--from", label="Begin", help="begin of the part")
    end_s: float | None = option(
        None, ge=0, unit="s", flag="--to", label="End", help="end of the part; by default the end of the episode"
    )
    in_place: bool = option(False, help="replace EPISODE; the original moves to .trash beside it")


@attrs.frozen(kw_only=True)
class DeleteOptions:
    """Episodes to delete."""

    episodes: tuple[Path, ...] = option(argument=True, names="episodes", help="episodes to delete")
    yes: bool = option(False, help="do not ask")
    to_trash: bool = option(False, help="move them to .trash beside them, without asking")


@attrs.frozen(kw_only=True)
class TrashOptions:
    """Actions on a trash."""

    path: Path = option(Path("episodes"), argument=True, names="episodes", help="folder of episodes")
    restore: str | None = option(None, help="put back the one with this id")
    empty: bool = option(False, help="delete all of them for good, after asking")
    yes: bool = option(False, help="do not ask")


@attrs.frozen(kw_only=True)
class RepairOptions:
    """Episodes to repair."""

    path: Path = option(argument=True, names="episodes", help="an episode, or a folder of them")


@attrs.frozen
class Changed(Event):
    """Something was changed."""

    path: str = option(help="the episode or folder")
    what: str = option(help="what was done")

    @override
    def shown(self) -> Shown:
        return Shown(f"{self.path}: {self.what}")


@attrs.frozen(kw_only=True)
class InTrash(Event):
    """An original in a trash."""

    id: str = option(help="unique within the trash; ids sort by time")
    done: str = option(choices=DONE, help="what was done with the episode")
    path: str = option(help="its original place")
    size_bytes: int = option(unit="bytes", help="size")

    @override
    def shown(self) -> Shown:
        return Shown(DONE[self.done])
