"""Spans: options with a value, or a range from which each episode draws one."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.api import option

Range = tuple[float, float]
Span = float | Range


def ordered(instance: Any, attribute: attrs.Attribute[Any], value: Range) -> None:
    """A validator of ranges."""
    if not value[0] <= value[1]:
        raise ValueError(f"[{value[0]}, {value[1]}] is not a valid range: the first value must not exceed the second")


def ends(span: Span) -> Range:
    """The lowest and the highest value of a span."""
    return span if isinstance(span, tuple) else (span, span)


def span(default: Span, *, help: str, ge: float, le: float, unit: str = "") -> Any:
    """An option with a value or a range `[lowest, highest]`, both from `ge` to `le`."""
    units = f" {unit}" if unit else ""

    def check(instance: Any, attribute: attrs.Attribute[Any], value: Span) -> None:
        ordered(instance, attribute, ends(value))
        for end in ends(value):
            if not ge <= end <= le:  # so that NaN fits not either
                raise ValueError(f"{end} is not from {ge} to {le}{units}")

    return option(default, unit=unit, validator=check, help=help)
