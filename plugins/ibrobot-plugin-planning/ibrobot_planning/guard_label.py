"""What the guard says of a command that it changed."""

from __future__ import annotations

import json


def label(first: str, second: str, distance: float | None) -> str:
    """As on `/guard`: two things and their distance [m], or `world` and why it is not known well enough."""
    return json.dumps({"first": first, "second": second, "distance": None if distance is None else round(distance, 4)})


def in_words(text: str) -> str:
    """A label for people."""
    read = json.loads(text)
    if read["distance"] is None:
        return f"{read['first']}: {read['second']}"
    return f"{read['first']} was {1000 * read['distance']:.1f} mm from {read['second']}"


def touches(text: str) -> bool:
    """Whether the two things of a label touch one another, as those do that the guard lets press."""
    distance = json.loads(text)["distance"]
    return distance is not None and distance <= 0
