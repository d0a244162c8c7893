"""The example plugin on the import path, as if it were installed."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "ibrobot-plugin-wave"))
