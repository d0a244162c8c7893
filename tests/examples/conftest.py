"""The example plugins on the import path, as if they were installed."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path[:0] = map(str, sorted(Path(__file__).parent.glob("ibrobot-plugin-*")))
if find_spec("ibrobot_diagnose") is None:
    collect_ignore = ["ibrobot-plugin-to-and-fro"]
