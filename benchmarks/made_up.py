"""A made-up plugin for a benchmark: found by this process and by those that it starts."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def plugin(name: str, source: str) -> Iterator[Path]:
    """Have a module with its entry point in a temporary folder, which is given and is on the path."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / f"{name}.py").write_text(source)
        metadata = folder / f"{name}-1.0.dist-info"
        metadata.mkdir()
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (metadata / "entry_points.txt").write_text(f"[ibrobot]\n{name} = {name}\n")
        sys.path.insert(0, made)
        os.environ["PYTHONPATH"] = os.pathsep.join([made, *filter(None, [os.environ.get("PYTHONPATH")])])
        yield folder
