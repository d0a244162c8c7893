"""The example plugins on the import path, as if they were installed."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path[:0] = map(str, sorted(Path(__file__).parent.glob("ibrobot-plugin-*")))
