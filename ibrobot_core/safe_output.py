"""Output of untrusted text to terminals and logs, without markup, control characters and secrets.

Untrusted are names of peers, strings in bags and files, values in YAMLs, replies of servos and texts of exceptions. All
output goes through `echo`, `LogFormatter`, or the `Screen` of `ibrobot_terminal.screen`, which call `printable`.
"""

from __future__ import annotations

import logging
import os
import re
import sys
from typing import override
from urllib.parse import quote

import click

from ibrobot_core.options import HIDDEN

_CONTROL = "\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b-\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\U000e0000-\U000e0fff"
_UNSEEN = "\xad\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\ufeff\uffa0\ufff0-\ufffb"
UNPRINTABLE = re.compile(f"[{_CONTROL}{_UNSEEN}]")
"""Control characters except tab and line feed, those that change the text direction or show nothing, so that two names
would look the same, and lone surrogates."""
_CREDENTIALS = re.compile(r"(?P<scheme>\b[A-Za-z][A-Za-z0-9+.-]*://)[^\s/?#]*@")
_PARAMETERS = re.compile(r"(?i)(?P<name>[?&](?:user(?:name)?|pass(?:word|wd)?|pwd|secret)=)[^&\s#'\"]+")
_TYPED = "`uv run ibrobot " if "UV_RUN_RECURSION_DEPTH" in os.environ else "`ibrobot "
"""How commands in texts begin: below `uv run`, the shell may not find `ibrobot` itself."""
SHORTEST = 8
"""Shorter secrets are hidden only in their options: their characters occur elsewhere, e.g. in names of files."""

_secrets: set[str] = set()


def remember_secret(value: str) -> None:
    """Hide a secret in all output from now on, including its forms in URLs and `repr`."""
    if len(value) >= SHORTEST:
        _secrets.update({value, quote(value, safe=""), repr(value)[1:-1]})


def without_credentials(text: str) -> str:
    """Hide user and password of every URL in a text."""
    return _PARAMETERS.sub(rf"\g<name>{HIDDEN}", _CREDENTIALS.sub(rf"\g<scheme>{HIDDEN}@", text))


def redacted(text: str) -> str:
    """Hide the secrets known to this process, and credentials in URLs."""
    for secret in sorted(_secrets, key=len, reverse=True):
        text = text.replace(secret, HIDDEN)
    return without_credentials(text)


def printable(text: str) -> str:
    r"""Make a text safe to show, and its commands as the user types them.

    Unprintable characters are escaped as in JSON and YAML, e.g. `\u001b`, and secrets hidden.
    """
    text = redacted(text).replace("`ibrobot ", _TYPED)
    return UNPRINTABLE.sub(lambda match: ("\\u%04x" if match[0] < "\U00010000" else "\\U%08x") % ord(match[0]), text)


def echo(message: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print a message; see `printable`."""
    # Pass the stream, since click otherwise writes UTF-8 to an ASCII terminal.
    click.echo(printable(str(message)), file=sys.stderr if err else sys.stdout, nl=nl)


class LogFormatter(logging.Formatter):
    """Indents all lines of a record after the first, so that no text can look like another record."""

    @override
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record)).replace("\n", "\n  ")
