"""Tables and live panels in a terminal, by Rich without markup. All use of Rich goes through this module."""

from __future__ import annotations

import errno
import os
from typing import Any, override

from rich.console import Console
from rich.text import Text

from ibrobot_core.app import printable


class Screen(Console):
    """A console that shows text literally: without markup, emoji codes, highlighting or control characters."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**{**options, "markup": False, "emoji": False, "highlight": False})

    @override
    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **{**options, "markup": False, "emoji": False})

    @override
    def on_broken_pipe(self) -> None:
        # Rich would exit without a word.
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))


def styled(value: object, style: str = "", **options: Any) -> Text:
    """A literal text with a style; `options` are those of Rich's `Text`."""
    return Text(printable(str(value)), style, **options)
