"""The process of a guide: `python -m ibrobot_web.ui.guide_process CHANNEL`, started by the view devices.

Its order has the guide's `name` and the `answers` to its questions. It sends the server `say`, `show`, `picture`,
and requests `{"ask": N, "kind": "confirm" | "wait", "text": …}` with `rows` while one waits; the server replies
`{"reply": N, "ok": …}`. It ends with `done` or a `Failure`, or when the server closes the channel.
"""

from __future__ import annotations

import base64
import itertools
import logging
import select
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, override

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import Channel, Failure, Guide, error_text, installed_plugins, open_parent

_POLL_S = 0.03
_ROWS_S = 0.1
"""Shortest time between two tables that are sent while the operator works [s]."""


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
        self._channel.send({"event": "picture", "title": title, "content": base64.b64encode(content).decode()})

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        return bool(self._ask("confirm", question, lambda number: None))

    @override
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Sequence[Sequence[str]]] | None = None, seconds: float | None = None,
    ) -> None:  # fmt: skip
        until_s = time.monotonic() + seconds if seconds is not None else None
        next_s = 0.0

        def meanwhile(number: int) -> None:
            nonlocal next_s
            if rows is None:
                return
            rows_now, now_s = rows(), time.monotonic()
            if now_s >= next_s:
                next_s = now_s + _ROWS_S
                self._channel.send({"event": "rows", "ask": number, "columns": columns, "rows": rows_now})

        self._ask("wait", request, meanwhile, until_s)

    def _ask(self, kind: str, text: str, meanwhile: Callable[[int], None], until_s: float | None = None) -> Any:
        number = next(self._numbers)
        self._channel.send({"event": "ask", "ask": number, "kind": kind, "text": text})
        while until_s is None or time.monotonic() < until_s:
            meanwhile(number)
            select.select([self._channel.fileno()], [], [], _POLL_S)
            for message in self._channel.receive():
                if message.get("reply") == number:
                    return message["ok"]
            if self._channel.closed:
                raise Left("cancelled")
        return True


def main() -> None:
    """Run the process."""
    channel = open_parent(int(sys.argv[1]))
    order = channel.wait(None)[0]
    try:
        guide = next(each for each in installed_plugins().guides if each.name == order["name"])
        guide.run(order["answers"], PageGuide(channel))
    except IbrobotError as error:
        channel.report(Failure(str(error) or type(error).__name__))
    except Exception as error:
        logging.getLogger("ibrobot.ui").exception("the guide %s failed", order["name"])
        channel.report(Failure(error_text(error)))
    else:
        channel.send({"event": "done"})
    channel.flush()


if __name__ == "__main__":
    main()
