"""What the guard says of a command that it changed."""

from __future__ import annotations

import json


def in_words(label: str) -> str:
    """A label of the guard for people."""
    read: str = json.loads(label)["text"]
    return read


def touches(label: str) -> bool:
    """Whether the two things of a label touch one another, as those do that the guard lets press."""
    distance = json.loads(label)["distance"]
    return distance is not None and distance <= 0
