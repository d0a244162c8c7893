"""Text from outside on its way to a terminal or a log: it is neither markup nor control characters, nor tells a secret.

Outside are names of peers, strings in bags and files, values in YAMLs, replies of servos, texts of exceptions. All
output goes through `echo`, `LogFormatter`, or the `Screen` of `ibrobot_core.screen`, which call `printable`.
"""

from __future__ import annotations

import logging
import re
import sys
from typing import override
from urllib.parse import quote

import click

from ibrobot_core.options import HIDDEN

_UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but for tab and line feed, what turns the direction of text, and lone surrogates."""
_CREDENTIALS = re.compile(r"(?P<scheme>\b[A-Za-z][A-Za-z0-9+.-]*://)[^\s/?#]*@")
_PARAMETERS = re.compile(r"(?i)(?P<name>[?&](?:user(?:name)?|pass(?:word|wd)?|pwd|secret)=)[^&\s#'\"]+")
_SHORTEST = 4
"""A secret of fewer characters is hidden where it is known to be one, not wherever its characters come."""

_secrets: set[str] = set()


def remember_secret(value: str) -> None:
    """Hide a secret in all that is shown from now on, also as it is written in a URL or a `repr`."""
    if len(value) >= _SHORTEST:
        _secrets.update({value, quote(value, safe=""), repr(value)[1:-1]})


def without_credentials(text: str) -> str:
    """A text with user and password of every URL in it hidden."""
    return _PARAMETERS.sub(rf"\g<name>{HIDDEN}", _CREDENTIALS.sub(rf"\g<scheme>{HIDDEN}@", text))


def redacted(text: str) -> str:
    """A text without secrets that this process knows, and without credentials in URLs."""
    for secret in sorted(_secrets, key=len, reverse=True):
        text = text.replace(secret, HIDDEN)
    return without_credentials(text)


def printable(text: str) -> str:
    r"""A text as it may be shown: unprintable characters as `\u001b`, which JSON and YAML read back; no secrets."""
    return _UNPRINTABLE.sub(lambda found: f"\\u{ord(found[0]):04x}", redacted(text))


def echo(message: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print a message; see `printable`."""
    # Named, or click writes UTF-8 to a terminal that has said ASCII.
    click.echo(printable(str(message)), file=sys.stderr if err else sys.stdout, nl=nl)


class LogFormatter(logging.Formatter):
    """Formats records so that each line that follows the first is indented: no text can look like another record."""

    @override
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record)).replace("\n", "\n  ")
