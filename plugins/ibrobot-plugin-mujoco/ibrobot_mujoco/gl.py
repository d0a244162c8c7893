"""Which OpenGL backend renders off-screen here; looks at libraries only, and imports no MuJoCo."""

from __future__ import annotations

import ctypes
import os
import sys

from ibrobot_core.descriptors import Check
from ibrobot_core.errors import SensorError

# What each backend loads, any name of a group; as MuJoCo's own context classes need it.
_LIBRARIES = {
    "egl": (("libEGL.so.1", "libEGL.so"), ("libOpenGL.so.0", "libGL.so.1", "libGL.so")),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),),
}
REMEDY = "apt install libegl1 libgl1-mesa-dri (or: apt install libosmesa6)"


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def usable() -> tuple[str, ...]:
    """The backends whose libraries are there, best first."""
    if sys.platform == "darwin":
        return ("cgl",)
    found = [
        backend
        for backend, groups in _LIBRARIES.items()
        if all(any(_loads(name) for name in group) for group in groups)
    ]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        found.append("glfw")
    return tuple(found)


def check_asked() -> str:
    """The backend that `MUJOCO_GL` asks for, empty where it asks for none.

    To be called ahead of importing MuJoCo, whose import fails obscurely on one that does not load.

    Raises:
        SensorError: when there is no such backend, or its libraries do not load.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    known = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa", "glfw")
    if asked and asked not in known:
        raise SensorError(f"MUJOCO_GL is {asked!r}, must be one of: {', '.join(known)}")
    if asked in _LIBRARIES and asked not in usable():
        raise SensorError(f"MUJOCO_GL={asked}, whose libraries do not load here; {REMEDY}, or unset MUJOCO_GL")
    return asked


def choose() -> str:
    """The backend to render with: what `MUJOCO_GL` says, or else the best that is usable.

    Raises:
        SensorError: when there is none.
    """
    asked = check_asked()
    if asked:
        return asked
    found = usable()
    if not found:
        raise SensorError(f"no OpenGL backend for simulated cameras: neither EGL nor OSMesa nor a display; {REMEDY}")
    return found[0]


def check() -> Check:
    """The line of `ibrobot doctor`."""
    try:
        chosen = choose()
    except SensorError as error:
        return Check("simulated cameras", False, str(error), REMEDY)
    return Check("simulated cameras", True, f"renders with {chosen} (usable: {', '.join(usable())})")
