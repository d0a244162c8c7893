"""Starts the node: `python run.py DESCRIPTOR`. Its interpreter may lack ibrobot, so that the package is a stub here."""

import sys
from pathlib import Path
from types import ModuleType

_PACKAGE = "ibrobot_ros"


def main() -> None:
    """Run the node until the run ends it."""
    folder = Path(__file__).resolve().parent
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != folder]
    package = ModuleType(_PACKAGE)
    package.__path__ = [str(folder.parent)]
    sys.modules[_PACKAGE] = package
    from ibrobot_ros.node.main import run

    run(int(sys.argv[1]))


if __name__ == "__main__":
    main()
