"""Milliseconds a frame of two simulated cameras in turn: full meshes against low-poly ones, with and without shadows.

The variants take turns frame by frame, so that whatever else the machine does meets all of them alike.
"""

from __future__ import annotations

import argparse
import json
import time

import attrs
import mujoco
import numpy as np
from ibrobot_mujoco.model import build_model, build_spec
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.render import Renderer
from ibrobot_mujoco.so101 import so101

WIDTH, HEIGHT = 640, 480
CAMERAS = ("top", "wrist_cam")
WARM_UP = 4


@attrs.define
class Variant:
    """One way to render, and how long its frames took [ms]."""

    name: str
    drawn: mujoco.MjData
    renderers: list[Renderer]
    took_ms: list[float] = attrs.field(factory=list)


def make_variant(name: str, model: mujoco.MjModel, *, shadows: bool) -> Variant:
    drawn = mujoco.MjData(model)
    drawn.joint("shoulder_lift").qpos = -0.8
    mujoco.mj_forward(model, drawn)
    cameras = [model.camera(camera).id for camera in CAMERAS]
    renderers = [Renderer(model, camera, WIDTH, HEIGHT, shadows=shadows) for camera in cameras]
    return Variant(f"{name}{'_shadows' if shadows else ''}", drawn, renderers)


def full_model() -> mujoco.MjModel:
    spec, _ = build_spec(MujocoOptions(), so101())
    spec.visual.quality.offsamples = 0
    return spec.compile()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=60, help="frames of each variant")
    frames = parser.parse_args().frames
    models = {"low_poly": build_model(MujocoOptions(), so101(), visual=True), "full": full_model()}
    variants = [make_variant(n, m, shadows=s) for n, m in models.items() for s in (False, True)]
    for frame in range(WARM_UP + frames):
        for variant in variants:
            start = time.perf_counter()
            variant.renderers[frame % 2].render(variant.drawn)
            variant.took_ms.append(1e3 * (time.perf_counter() - start))
    took = np.array([variant.took_ms[WARM_UP:] for variant in variants])
    median, p99 = np.percentile(took, (50, 99), axis=1).round(1)
    result: dict[str, object] = {"frames": frames, "backend": variants[0].renderers[0].backend, "size": [WIDTH, HEIGHT]}
    result |= {f"{v.name}_ms": {"p50": m, "p99": p} for v, m, p in zip(variants, median, p99, strict=True)}
    print(json.dumps(result | {"full_to_low_poly": round(float(np.median(took[2] / took[0])), 1)}))
    for variant in variants:
        for renderer in variant.renderers:
            renderer.close()


if __name__ == "__main__":
    main()
