"""Event of `ibrobot record`."""

from __future__ import annotations

from typing import Any, override

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import Event, Shown


@attrs.frozen(kw_only=True)
class Session(Event):
    """The state of a recording session."""

    folder: str = option(help="folder of the dataset")
    saved: int = option(help="episodes saved so far")
    wanted: int | None = option(help="episodes after which it ends; null: it does not end by itself")
    state: str = option(help="what it does at present")

    @override
    def shown(self) -> Shown:
        count = counted(self.saved, "episode")
        progress = None
        if self.wanted is not None:
            count = f"{self.saved} of {counted(self.wanted, 'episode')}"
            progress = min(1.0, self.saved / self.wanted)
        made: dict[str, Any] = {"episodes": self.folder} if self.saved else {}
        return Shown(f"{self.state} · {count} saved", progress, made=made)
