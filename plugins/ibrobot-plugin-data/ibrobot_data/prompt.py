"""Check of prompts, which are written to YAML, JSON and datasets, and sent to policies."""

from __future__ import annotations

import re

from ibrobot_core.api import RecorderError

_LONGEST = 1000
"""Maximum length, the same as of a text in a request to a service [characters]."""
_UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


def check_prompt(prompt: str) -> str:
    """Return the prompt if every file format can hold it.

    Raises:
        RecorderError: if it is too long, or has control characters or halves of characters.
    """
    if len(prompt) > _LONGEST:
        raise RecorderError(f"the prompt has {len(prompt)} characters; at most {_LONGEST} are allowed")
    if unprintable := _UNPRINTABLE.search(prompt):
        place = f"U+{ord(unprintable[0]):04X} at character {unprintable.start() + 1}"
        raise RecorderError(f"the prompt has a character that no file can hold: {place}")
    return prompt
