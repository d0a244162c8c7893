"""Tables and live panels in a terminal: the one way to Rich, in which no text is ever markup."""

from __future__ import annotations

from typing import Any, override

from rich.console import Console
from rich.text import Text

from ibrobot_core.outside import printable


class Screen(Console):
    """A console that shows every text as it is: without markup, emoji codes, highlighting or control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**options, "markup": False, "emoji": False, "highlight": False})

    @override
    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **{**options, "markup": False, "emoji": False})


def styled(value: object, style: str = "", **options: Any) -> Text:
    """A text with a style, and otherwise as it is; `options` are those of Rich's `Text`."""
    return Text(printable(str(value)), style, **options)
