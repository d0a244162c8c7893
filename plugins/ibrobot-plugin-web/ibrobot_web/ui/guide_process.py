"""The process of a guide: `python -m ibrobot_web.ui.guide_process CHANNEL`, started by the view devices.

Its order has the guide's `name` and the `answers` to its questions. It sends the server `say`, `show`, `picture`,
and requests `{"ask": N, "kind": "confirm" | "wait", "text": …}` with `rows` and `sight` while one waits; the server
replies `{"reply": N, "ok": …}`. It ends with `done` or a `Failure`, or when the server closes the channel.
"""

from __future__ import annotations

import itertools
import logging
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

from ibrobot_terminal import Guide
from ibrobot_terminal.guide import installed_guides

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Channel, run_child

_POLL_S = 0.03
_ROWS_S, _SIGHT_S = 0.1, 0.2
"""Shortest times between two tables and two pictures that are sent while the operator works [s]."""


class Left(IbrobotError):
    """The operator has cancelled the guide or closed the page's server."""


class PageGuide(Guide):
    """The operator at a page.

    Args:
        channel: to the server.
    """

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._numbers = itertools.count(1)

    @override
    def say(self, text: str, *, warning: bool = False) -> None:
        self._channel.send({"event": "say", "text": text.strip(), "warning": warning})

    @override
    def show(self, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        self._channel.send({"event": "show", "columns": columns, "rows": rows})

    @override
    def picture(self, title: str, content: bytes) -> None:
        self._channel.send({"event": "picture", "title": title}, content)

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        return bool(self._ask("confirm", question, lambda number: None))

    @override
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Sequence[Sequence[str]]] | None = None, sight: Callable[[], bytes | None] | None = None,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        until_s = time.monotonic() + seconds if seconds is not None else None
        next_s = sight_s = 0.0

        def meanwhile(number: int) -> None:
            nonlocal next_s, sight_s
            rows_now, now_s = rows() if rows is not None else None, time.monotonic()
            if rows_now is not None and now_s >= next_s:
                next_s = now_s + _ROWS_S
                self._channel.send({"event": "rows", "ask": number, "columns": columns, "rows": rows_now})
            if sight is not None and now_s >= sight_s:
                sight_s = now_s + _SIGHT_S
                if (shown := sight()) is not None:
                    self._channel.send({"event": "sight", "ask": number}, shown)

        self._ask("wait", request, meanwhile, until_s)

    def _ask(self, kind: str, text: str, meanwhile: Callable[[int], None], until_s: float | None = None) -> Any:
        number = next(self._numbers)
        self._channel.send({"event": "ask", "ask": number, "kind": kind, "text": text})
        while until_s is None or time.monotonic() < until_s:
            meanwhile(number)
            for message in self._channel.receive(_POLL_S):
                if message.get("reply") == number:
                    return message["ok"]
            if self._channel.closed:
                raise Left("cancelled")
        return True


def run(channel: Channel, order: Mapping[str, Any]) -> None:
    """Run the guide."""
    guide = next(each for each in installed_guides() if each.type == order["name"])
    try:
        guide.make(order["answers"], PageGuide(channel))
    except Exception as error:
        if not isinstance(error, IbrobotError):
            logging.getLogger("ibrobot.ui").exception("the guide %s failed", order["name"])
        raise
    channel.send({"event": "done"})


if __name__ == "__main__":
    sys.exit(run_child(run))
