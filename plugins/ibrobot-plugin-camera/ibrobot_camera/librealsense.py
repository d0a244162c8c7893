"""Intel's library for RealSense cameras, which is an extra of this plugin and needs a system library."""

from __future__ import annotations

import sys
from typing import Any

from ibrobot_core.api import MissingDependency, how_to_install

_PACKAGES = {"libusb-1.0.so.0": "libusb-1.0-0", "libudev.so.1": "libudev1"}
"""System library -> the Debian package that contains it."""


def load_library() -> Any:
    """Import the module `pyrealsense2`.

    Raises:
        MissingDependency: if it, or a system library that it needs, is not installed; names which.
    """
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        if sys.platform == "darwin":
            remedy = "pyrealsense2 has no wheels for macOS, use Linux"
        else:
            remedy = how_to_install("ibrobot-plugin-camera[realsense]")
        raise MissingDependency("the Python package pyrealsense2 is not installed", remedy=remedy) from None
    except ImportError as error:
        library = str(error).partition(":")[0]
        missing = f"pyrealsense2 cannot be loaded: {error}"
        if library in _PACKAGES:
            raise MissingDependency(missing, apt=[_PACKAGES[library]]) from None
        raise MissingDependency(missing, remedy=f"install the system package that contains {library}") from None
    return pyrealsense2
