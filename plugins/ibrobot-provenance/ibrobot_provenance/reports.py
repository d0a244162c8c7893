"""Reports as data: what a plugin says of a folder with results. A file and a page can show the same."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import attrs

from ibrobot_core.api import Descriptor
from ibrobot_core.app import installed_plugins
from ibrobot_provenance.work import Work

PLOT_CLASSES = (
    "ok", "bad", "bad-fill", "faint", "range", "band", "estimate", "grid", "zero", "margin", "label",
)  # fmt: skip
"""Classes of the shapes in plots, coloured by the page: `ok` and `faint` fill successes, `bad` is the stroke and
`bad-fill` the fill of failures, `range` and `estimate` are strokes, `band` is a fill."""


_text = attrs.validators.instance_of(str)
_texts = attrs.validators.deep_iterable(_text, attrs.validators.instance_of(tuple))
"""A field of another type is a TypeError, since reports are read from files."""


@attrs.frozen
class Text:
    """A paragraph."""

    text: str = attrs.field(validator=_text)
    role: Literal["plain", "verdict", "note", "title"] = "plain"


@attrs.frozen
class Table:
    """A table."""

    columns: tuple[str, ...] = attrs.field(validator=_texts)
    rows: tuple[tuple[str, ...], ...] = attrs.field(validator=attrs.validators.deep_iterable(_texts))


@attrs.frozen
class Plots:
    """Plots side by side, each an SVG of lines, rects, circles, paths, polygons, polylines, texts and titles."""

    pictures: tuple[str, ...] = attrs.field(validator=_texts)


@attrs.frozen
class Cases:
    """Episodes worth a look, e.g. failures."""

    cases: tuple[Case, ...]


@attrs.frozen
class Fix:
    """What a click on a page does to an episode; the same page can undo it."""

    label: str
    does: Literal["delete", "trim", "mark"]
    outcome: str = ""
    """What it is judged, for `mark`, and after a `trim` that cuts the end off, with which a recording loses its own."""
    begin_s: float = 0.0
    """The part that a `trim` keeps [s]."""
    end_s: float = 0.0


@attrs.frozen
class Case:
    """An episode, or a picture, worth a look."""

    title: str = attrs.field(validator=_text)
    text: str = attrs.field(validator=_text)
    episode: Path | None
    """Its recording; None if there is none."""
    video: Path | None = None
    command: str = ""
    """The command that repeats it."""
    at_s: float = 0.0
    """Where to begin to play the recording [s]."""
    fixes: tuple[Fix, ...] = ()
    """What can be done to the recording, the likeliest first."""
    picture: Path | None = None
    """A PNG or JPEG file."""


@attrs.frozen
class ReportSection:
    """A part of a report, with a title."""

    title: str = attrs.field(validator=_text)
    blocks: tuple[Text | Table | Plots | Cases, ...]


@attrs.frozen
class ReportDescriptor(Descriptor[Any]):
    """Folders with results that pages list, and show as a report; `type` as in `Shown.made`, e.g. `evaluation`."""

    make: Callable[[Path], Sequence[ReportSection]] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Returns the report on a folder; raises IbrobotError."""
    reads: Callable[[Path], bool] = attrs.field(kw_only=True)
    """Returns whether a folder is one, by the names of its files."""
    lines: Callable[[Path], Sequence[str]] = attrs.field(kw_only=True)
    """Returns the result of a folder in a few lines; raises IbrobotError."""
    command: str = attrs.field(default="", kw_only=True)
    """The command that writes such folders, e.g. `eval`; on pages its view leads to the reports."""
    work: Work | None = attrs.field(default=None, kw_only=True)
    """How those who use a run have one made, e.g. agents; None if they cannot."""


def kinds_of_reports() -> dict[str, ReportDescriptor]:
    """Type -> descriptor, of the installed plugins."""
    known = installed_plugins().of_kind("report")
    return {each.type: each for each in known if isinstance(each, ReportDescriptor)}
