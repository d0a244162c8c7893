"""Minimal implementations of the kinds that this package defines, for tests and for new packages."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import override

from ibrobot_core.app import RequestError, RunView
from ibrobot_terminal.guide import Cells, Guide


def fake_guide(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Count the marks that the operator presses on.

    Raises:
        RequestError: if the number of marks makes no sense.
    """
    text = str(answers.get("marks", ""))
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 100):
        raise RequestError(f"marks is {text!r}, must be a number from 1 to 99")
    for mark in range(1, int(text) + 1):
        guide.wait(f"Press on mark {mark}.")
    guide.show(("mark", ">pressed"), [(str(mark), "1") for mark in range(1, int(text) + 1)])
    guide.say("Done.")


def fake_panel(session: RunView) -> Cells:
    """Each joint with its position; no rows before the first reading."""
    return list(_rows(session))


def _rows(session: RunView) -> Iterator[tuple[str, str]]:
    if session.state is not None:
        measured = session.measured()
        for name, position in zip(session.config.robot.joint_names, measured.position.tolist(), strict=True):
            yield name, f"{position:.3f} rad"


class FakeGuide(Guide):
    """An operator who does what is asked at once, and says yes.

    Attributes:
        said: texts, titles of pictures and requests, in their order.
        columns: the columns of the tables that were shown.
        tables: their rows.
        sights: the pictures that were shown while the operator worked.
    """

    def __init__(self) -> None:
        self.said: list[str] = []
        self.columns: list[tuple[str, ...]] = []
        self.tables: list[Cells] = []
        self.sights: list[bytes] = []

    @override
    def say(self, text: str, *, warning: bool = False) -> None:
        self.said.append(text)

    @override
    def show(self, columns: Sequence[str], rows: Cells) -> None:
        self.columns.append(tuple(columns))
        self.tables.append(rows)

    @override
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        self.said.append(question)
        return True

    @override
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Cells] | None = None, sight: Callable[[], bytes | None] | None = None,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        self.said.append(request)
        if rows is not None:
            self.tables.append(rows())
        if sight is not None and (shown := sight()) is not None:
            self.sights.append(shown)
