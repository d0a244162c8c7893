"""Elements of SVG plots and pages, which take the colours of the page that shows them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import attrs


@attrs.frozen
class Axis:
    """Maps values to positions on the page [px]."""

    low: float
    high: float
    begin: float
    end: float

    def __call__(self, value: float) -> float:
        """The position of a value, to a tenth of a pixel."""
        span = (self.high - self.low) or 1.0
        return round(self.begin + (value - self.low) / span * (self.end - self.begin), 1)

    def ticks(self, most: int = 6) -> list[float]:
        """Round values along the axis."""
        span = self.high - self.low
        if span <= 0:
            return [self.low]
        step = 10.0 ** math.floor(math.log10(span / most))
        step *= next(factor for factor in (1, 2, 5, 10) if span / (step * factor) <= most)
        first = math.ceil(self.low / step - 1e-9)
        return [round(step * (first + i), 10) for i in range(int((self.high - step * first) / step + 1e-9) + 1)]


def axis_of(values: Sequence[float], begin: float, end: float) -> Axis:
    """An axis that contains all values, with a margin."""
    low, high = min(values), max(values)
    room = 0.05 * (high - low) or 0.5
    return Axis(low - room, high + room, begin, end)


def tag(name: str, text: str = "", **attributes: Any) -> str:
    """An SVG or HTML element; underscores in attribute names stand for hyphens."""
    given = "".join(f' {key.rstrip("_").replace("_", "-")}="{escape(str(each))}"' for key, each in attributes.items())
    return f"<{name}{given}>{text}</{name}>"


def svg(width: float, height: float, parts: Sequence[str], title: str) -> str:
    """A picture that scales with the page while its texts can be read, with a title for screen readers."""
    inner = tag("title", escape(title)) + "".join(parts)
    style = f"min-width:{0.8 * width:g}px;max-width:{width:g}px"
    return tag("svg", inner, viewBox=f"0 0 {width} {height}", style=style, role="img")


def caption(x: float, y: float, text: str, anchor: str = "middle", class_: str = "") -> str:
    """A text."""
    return tag("text", escape(text), x=x, y=y, text_anchor=anchor, **({"class_": class_} if class_ else {}))


def stroke(x1: float, y1: float, x2: float, y2: float, class_: str) -> str:
    """A straight line."""
    return tag("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def grid_below(axis: Axis, top: float, bottom: float, label: str) -> list[str]:
    """Grid and labels of a horizontal axis."""
    parts = []
    for value in axis.ticks():
        x = axis(value)
        parts += [stroke(x, top, x, bottom, "grid"), caption(x, bottom + 15, f"{value:g}")]
    return [*parts, caption((axis.begin + axis.end) / 2, bottom + 29, label, class_="label")]


def grid_beside(axis: Axis, left: float, right: float) -> list[str]:
    """Grid and labels of a vertical axis."""
    parts = []
    for value in axis.ticks(5):
        y = axis(value)
        parts += [stroke(left, y, right, y, "grid"), caption(left - 6, y + 4, f"{value:g}", "end")]
    return parts
