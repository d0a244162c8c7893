"""Guides, which lead an operator through work at a device, in a terminal or on a page."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import attrs

Cells = Sequence[Sequence[str]]


@attrs.frozen
class Question:
    """A field of the form in front of a guide. Its answer is a text, or True or False if `default` is."""

    name: str
    text: str
    default: str | bool = ""
    choices: tuple[str, ...] = ()
    """Suggestions if `open`, otherwise the only possible answers; none for any text."""
    open: bool = False
    """Whether answers other than the `choices` are possible."""


class Guide(ABC):
    """The operator, as the work sees them: shows them texts, tables and pictures, and waits for them.

    An operator who leaves ends the work by an exception, wherever it waits.
    """

    @abstractmethod
    def say(self, text: str, *, warning: bool = False) -> None:
        """Show a text."""

    @abstractmethod
    def show(self, columns: Sequence[str], rows: Cells) -> None:
        """Show a table. Columns whose names begin with `>` contain numbers."""

    @abstractmethod
    def confirm(self, question: str, *, flag: str = "", default: bool = False) -> bool:
        """Ask a yes/no question.

        Args:
            question: e.g. `Overwrite it?`.
            flag: the option that answers it where nobody can be asked.
            default: the answer that is offered first.
        """

    @abstractmethod
    def wait(
        self, request: str, *, flag: str = "", columns: Sequence[str] = (),
        rows: Callable[[], Cells] | None = None, seconds: float | None = None,
    ) -> None:  # fmt: skip
        """Ask the operator to do something, and wait until they say that it is done.

        Args:
            request: what to do.
            flag: the option that does without, where nobody can be asked.
            columns: heads of a table that is shown meanwhile.
            rows: returns its present rows; called at least 20 times a second.
            seconds: time after which it counts as done [s]; None: the operator says so.
        """

    def picture(self, title: str, content: bytes) -> None:
        """Show a JPEG or PNG, where pictures can be shown."""
