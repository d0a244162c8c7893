"""Events of the commands that change episodes."""

from __future__ import annotations

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
