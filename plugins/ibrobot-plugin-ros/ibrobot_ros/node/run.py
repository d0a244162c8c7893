"""Starts the node: `python run.py MODULE DESCRIPTOR`. Its interpreter may lack ibrobot, so stubs are its packages."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def stub(module: str) -> None:
    """Have `ibrobot_ros` without what it imports, and of `ibrobot_core.app` the module of the channel, a file."""
    package = sys.modules["ibrobot_ros"] = ModuleType("ibrobot_ros")
    package.__path__ = [str(Path(__file__).resolve().parents[1])]
    sys.modules["ibrobot_core"] = ModuleType("ibrobot_core")
    spec = importlib.util.spec_from_file_location("ibrobot_core.app", module)
    assert spec is not None
    assert spec.loader is not None
    sys.modules["ibrobot_core.app"] = channel = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(channel)


def main() -> None:
    """Run the node until the run ends it."""
    folder = Path(__file__).resolve().parent
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != folder]
    stub(sys.argv[1])
    from ibrobot_ros.node.main import run

    run(int(sys.argv[2]))


if __name__ == "__main__":
    main()
