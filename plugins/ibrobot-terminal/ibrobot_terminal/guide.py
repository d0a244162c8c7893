"""What an operator sees: guides through work at a device, in a terminal or on a page, and tables about a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import Descriptor
from ibrobot_core.app import installed_plugins

if TYPE_CHECKING:
    from ibrobot_core.app import RunView

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
        rows: Callable[[], Cells] | None = None, sight: Callable[[], bytes | None] | None = None,
        seconds: float | None = None,
    ) -> None:  # fmt: skip
        """Ask the operator to do something, and wait until they say that it is done.

        Args:
            request: what to do.
            flag: the option that does without, where nobody can be asked.
            columns: heads of a table that is shown meanwhile.
            rows: returns its present rows; called at least 20 times a second.
            sight: returns a JPEG that is shown meanwhile, in place of the last one, or None if there is no newer one;
                called a few times per second, where pictures can be shown.
            seconds: time after which it counts as done [s]; None: the operator says so.
        """

    def picture(self, title: str, content: bytes) -> None:
        """Show a JPEG or PNG, where pictures can be shown."""


@attrs.frozen
class GuideDescriptor(Descriptor[Any]):
    """Work at a device in which an operator takes part, for pages, e.g. a calibration. Its `label` is its title."""

    make: Callable[[Mapping[str, str | bool], Guide], None] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Does the work in a process of its own, with the answers to the questions by name."""
    questions: Callable[[], Sequence[Question]] = attrs.field(default=lambda: (), kw_only=True)
    """Returns the questions that are asked first, e.g. for the port, with what is plugged in as choices."""
    order: int = attrs.field(default=1000, kw_only=True)
    """Place among the guides, as a new user needs them: to find a port comes before a calibration."""


def installed_guides() -> list[GuideDescriptor]:
    """The guides of all plugins, in their order."""
    guides = [each for each in installed_plugins().of_kind("guide") if isinstance(each, GuideDescriptor)]
    return sorted(guides, key=lambda each: each.order)


@attrs.frozen
class PanelDescriptor(Descriptor[Any]):
    """A table about a run, for viewers, e.g. temperatures. Its `label` is its title."""

    make: Callable[[RunView], Cells] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Returns the present rows with one text for each column; none for a run that the panel does not concern. Called a
    few times per second, in a thread of the host."""
    columns: tuple[str, ...] = attrs.field(kw_only=True)
    """The heads of the columns; the first column names the rows."""
