"""Finds an OpenGL backend for off-screen rendering; loads system libraries only, and does not import MuJoCo."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any

from ibrobot_core.api import MissingDependency

# Libraries of each backend, any name of a group, as in MuJoCo's context classes.
_LIBRARIES = {
    "egl": (("libEGL.so.1",), ("libOpenGL.so.0", "libGL.so.1", "libGL.so")),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),),
}
PACKAGES = ("libegl1", "libopengl0", "libgl1-mesa-dri")
"""Debian packages with EGL and a software renderer, for a machine without a display."""
_EGL_PLATFORM_DEVICE_EXT = 0x313F
_MOST_DEVICES = 16


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


@cache
def _egl_has_a_driver() -> bool:
    """Whether EGL has a device to render on; the library without drivers has none."""
    egl = ctypes.CDLL("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    find_devices = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    find_display = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not find_devices or not find_display:
        return False
    pointer = ctypes.c_void_p
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.POINTER(pointer), ctypes.POINTER(ctypes.c_int))
    display_of = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(find_display)
    devices, count = (pointer * _MOST_DEVICES)(), ctypes.c_int()
    query(find_devices)(_MOST_DEVICES, devices, ctypes.byref(count))
    displays = [display_of(_EGL_PLATFORM_DEVICE_EXT, device, None) for device in devices[: count.value]]
    # Do not terminate the display: renderers in this process may share it.
    return any(display and egl.eglInitialize(pointer(display), None, None) for display in displays)


def usable() -> tuple[str, ...]:
    """The backends that work on this machine, best first."""
    if sys.platform == "darwin":
        return ("cgl",)
    platforms = [
        backend
        for backend, groups in _LIBRARIES.items()
        if all(any(_loads(name) for name in group) for group in groups) and (backend != "egl" or _egl_has_a_driver())
    ]
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        platforms.append("glfw")
    return tuple(platforms)


def check_asked() -> str:
    """The backend that `MUJOCO_GL` selects; empty if it is not set.

    Call it before importing MuJoCo, whose import fails with an obscure error if the backend does not load.

    Raises:
        MissingDependency: if there is no such backend, or it does not work on this machine.
    """
    # Make Mesa's software renderer draw in the calling thread: threads of its own would lack that thread's priority,
    # and be late beside a busy program.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    asked = os.environ.get("MUJOCO_GL", "").strip().lower()
    known = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa", "glfw")
    if asked and asked not in known:
        remedy = f"set it to one of {', '.join(known)}, or unset it"
        raise MissingDependency(f"MUJOCO_GL is {asked!r}, which is not an OpenGL backend", remedy=remedy)
    if asked in _LIBRARIES and asked not in usable():
        packages = PACKAGES if asked == "egl" else ("libosmesa6",)
        raise MissingDependency(f"MUJOCO_GL={asked} does not work on this machine (or unset it)", apt=packages)
    return asked


def choose() -> str:
    """The backend to render with: that of `MUJOCO_GL`, or else the best usable one.

    Raises:
        MissingDependency: if there is none, or the one of `MUJOCO_GL` does not work.
    """
    asked = check_asked()
    if asked:
        return asked
    platforms = usable()
    if not platforms:
        missing = "no OpenGL that renders without a display, neither EGL with a driver nor OSMesa"
        raise MissingDependency(missing, apt=PACKAGES)
    return platforms[0]


def from_module(module: str, name: str) -> Callable[..., Any]:
    """A function or class of a module of this package that imports MuJoCo, which the first call does.

    Raises:
        MissingDependency: when it is called, if `MUJOCO_GL` names a backend that would break the import.
    """

    def made(*arguments: Any) -> Any:
        check_asked()
        return getattr(import_module(f"ibrobot_mujoco.{module}"), name)(*arguments)

    return made
