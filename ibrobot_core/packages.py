"""What installs several packages of this project at once: the extras of the distribution `ibrobot`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

EXTRAS = Path(__file__).with_name("official_extras.json")
"""Extra of `ibrobot` -> the packages that it installs. `python tests/house/official_plugins.py` writes it."""


def install_command(packages: Iterable[str]) -> str:
    """One line that installs packages: the smallest extra of `ibrobot` that has all of several, or their names."""
    wanted = list(dict.fromkeys(packages))
    extras: dict[str, list[str]] = json.loads(EXTRAS.read_bytes())
    covering = [name for name, content in extras.items() if len(wanted) > 1 and set(wanted) <= set(content)]
    if covering:
        return f'pip install "ibrobot[{min(covering, key=lambda name: len(extras[name]))}]"'
    return f"pip install {' '.join(wanted)}"
