"""Bugs, of ibrobot or of a plugin: one line for the terminal, which names the file that has the traceback."""

from __future__ import annotations

import os
import sys
import tempfile
import traceback

from ibrobot_core.outside import printable

DEBUG = "IBROBOT_DEBUG"
"""Environment variable that has tracebacks printed, in the processes of a run too; `ibrobot --debug` sets it."""
_NOTED = "its traceback is in "


def describe_bug(error: BaseException) -> str:
    """What was raised and where, and the file that has the traceback, which is written once for each error."""
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
        except OSError as full:  # e.g. no space: the terminal is the only place left
            sys.stderr.write(text)
            return f"{message} (no file for its traceback: {full.strerror})"
        notes = [f"{_NOTED}{name}"]
        error.add_note(notes[0])
    return f"{message} ({_place(error)}{notes[0]})"


def _place(error: BaseException) -> str:
    """The package and line that raised; empty for an error that nothing raised."""
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return ""
    file = "/".join(frames[-1].filename.split(os.sep)[-2:])
    return f"a bug at {file}:{frames[-1].lineno}; "
