"""Off-screen rendering of a scene, with an available OpenGL backend."""

from __future__ import annotations

import importlib
import threading
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import SensorError
from ibrobot_mujoco import gl

_drawing = threading.Lock()
"""Held while a context is made, drawn in, read or freed. All contexts of the process share EGL's display, and so the
screen of the driver: Mesa 22.3's software renderer crashed once while two cameras drew at the same time."""


class Renderer:
    """Renders the view of one camera. Create, use and close it in the same thread, to which its OpenGL context belongs.

    MuJoCo's own renderer selects a backend when `mujoco` is first imported; this one when it is created.

    Raises:
        MissingDependency: if no backend works on this machine.
        SensorError: if the backend cannot create a context.
    """

    def __init__(self, model: mujoco.MjModel, camera: int, width: int, height: int, *, shadows: bool) -> None:
        self._model = model
        model.vis.global_.offwidth = width
        model.vis.global_.offheight = height
        with _drawing:
            self.backend = gl.choose()
            self._context = _make_context(self.backend, width, height)
            self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._option = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = camera
        self._rect = mujoco.MjrRect(0, 0, width, height)

    def render(self, drawn: mujoco.MjData) -> NDArray[np.uint8]:
        """The camera's image of `drawn`, shape (height, width, 3), RGB, top row first."""
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        self._draw(drawn, pixels, None)
        return np.ascontiguousarray(pixels[::-1])

    def render_depth(self, drawn: mujoco.MjData) -> NDArray[np.float32]:
        """Distance along the optical axis of the camera's pixels [m], shape (height, width), top row first.

        The background is at the far clipping plane.
        """
        buffer = np.empty((self._rect.height, self._rect.width), np.float32)
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._draw(drawn, None, buffer)
        # The buffer is n (f - z) / (z (f - n)) for clipping planes at n and f.
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        depth = far * near / (buffer.astype(float) * (far - near) + near)
        return np.ascontiguousarray(depth[::-1].astype(np.float32))

    def render_geoms(self, drawn: mujoco.MjData) -> NDArray[np.int32]:
        """The number of the geom in each of the camera's pixels, -1 for none, shape (height, width), top row first."""
        flags = [int(mujoco.mjtRndFlag.mjRND_SEGMENT), int(mujoco.mjtRndFlag.mjRND_IDCOLOR)]
        self._scene.flags[flags] = True
        try:
            codes = self.render(drawn).astype(np.int32)
        finally:
            self._scene.flags[flags] = False
        numbers = codes[..., 0] + (codes[..., 1] << 8) + (codes[..., 2] << 16)
        geom_of = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and 0 <= geom.segid < self._scene.ngeom:
                geom_of[geom.segid + 1] = geom.objid
        result: NDArray[np.int32] = geom_of[np.clip(numbers, 0, self._scene.ngeom)]
        return result

    def _draw(self, drawn: mujoco.MjData, pixels: NDArray[np.uint8] | None, depths: NDArray[np.float32] | None) -> None:
        """Draw, and read the bottom row first into `pixels`, shape (height, width, 3), or `depths`, (height, width)."""
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, drawn, self._option, None, self._view, everything, self._scene)
        with _drawing:
            self._context.make_current()
            mujoco.mjr_render(self._rect, self._scene, self._mjr)
            mujoco.mjr_readPixels(pixels, depths, self._rect, self._mjr)

    def close(self) -> None:
        """Release the context. Safe to call twice."""
        with _drawing:
            if self._context is not None:
                self._context.make_current()
                self._mjr.free()
                self._context.free()
                self._context = None


def _make_context(backend: str, width: int, height: int) -> Any:
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
        context.make_current()
    except Exception as error:
        raise SensorError(f"OpenGL backend {backend} makes no context here: {error}") from error
    return context
