"""Reports of bugs in ibrobot or a plugin: one line for the terminal, which names the file with the traceback."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback

from ibrobot_core.errors import ComponentFailed, IbrobotError
from ibrobot_core.safe_output import printable

DEBUG = "IBROBOT_DEBUG"
"""Environment variable that enables tracebacks in all processes of a run; `ibrobot --debug` sets it."""
_NOTED = "its traceback is in "


def describe_bug(error: BaseException, *, placed: bool = True) -> str:
    """The error, its place, and the file with its traceback, which is written once per error.

    Args:
        error: what was raised.
        placed: whether to name the place; the one that raised it is not always the one to blame.
    """
    text = printable("".join(traceback.format_exception(error)))
    message = f"{type(error).__name__}: {error}".strip().removesuffix(":").replace("\n", "; ")
    if os.environ.get(DEBUG):
        sys.stderr.write(text)
        return message
    notes = [note for note in getattr(error, "__notes__", ()) if note.startswith(_NOTED)]
    if not notes:
        try:
            file, name = tempfile.mkstemp(prefix="ibrobot-", suffix=".log")
            with open(file, "w", encoding="utf-8", errors="backslashreplace") as log:
                log.write(text)
        except OSError as full:  # e.g. no space: print the traceback instead
            sys.stderr.write(text)
            return f"{message} (no file for its traceback: {full.strerror})"
        notes = [f"{_NOTED}{name}"]
        error.add_note(notes[0])
    return f"{message} ({_place(error) if placed else ''}{notes[0]})"


def _place(error: BaseException) -> str:
    """The package and line that raised the error; empty for an error that was not raised."""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return ""
    file = "/".join(frames[-1].filename.split(os.sep)[-2:])
    return f"a bug at {file}:{frames[-1].lineno}; "


def as_failure(error: BaseException) -> Exception:
    """The failure of a thread that `error` ended; `sys.exit` in a thread would otherwise end it in silence."""
    return error if isinstance(error, Exception) else ComponentFailed(f"its thread was ended by {error!r}")


def error_text(error: BaseException, newline: str = "\n") -> str:
    """The message of an error; its lines are separated by `newline`."""
    text = str(error).strip() if isinstance(error, IbrobotError) else describe_bug(error)
    return text.replace("\n", newline)


def exit_code(error: BaseException) -> int:
    """The exit status of a run ended by `error`."""
    return error.exit_code if isinstance(error, IbrobotError) else 1
