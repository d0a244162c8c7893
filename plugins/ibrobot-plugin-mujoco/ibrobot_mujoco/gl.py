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


def choose() -> str:
    """The backend to render with: what `MUJOCO_GL` says, or else the best that is usable.

    Raises:
        SensorError: when there is none.
    """
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    known = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa", "glfw")
    if asked:
        if asked not in known:
            raise SensorError(f"MUJOCO_GL is {asked!r}, must be one of: {', '.join(known)}")
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
    found = usable()
    if chosen not in found:
        return Check("simulated cameras", False, f"MUJOCO_GL={chosen}, whose libraries do not load", REMEDY)
    return Check("simulated cameras", True, f"renders with {chosen} (usable: {', '.join(found)})")
