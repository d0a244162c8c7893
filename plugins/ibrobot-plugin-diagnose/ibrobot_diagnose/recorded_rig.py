"""The rig that a window shows: its stills, rates, calibration and versions."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.rig import Rig, RigCamera, Still
from ibrobot_diagnose.window import Window


def rig_of(window: Window) -> Rig | None:
    """The rig in a window; None if it says nothing of it."""
    if not window.joints or not window.metadata:
        return None
    document, metadata = window.document, window.metadata
    settings = {str(each.get("name")): _settings(each) for each in document.get("peripherals") or ()}
    names = {
        str(each.get("key")): str(each.get("peripheral"))
        for each in (document.get("contract") or {}).get("observations") or ()
    }
    cameras = {}
    for key, camera in window.cameras.items():
        if camera.stills:
            times = np.array(list(camera.stills), np.int64)
            poses = window.state.at(times)
            stills = tuple(Still(picture, pose) for picture, pose in zip(camera.stills.values(), poses, strict=True))
            rate = None if window.sampled else rate_of(np.array(camera.times_ns, np.int64))
            cameras[key] = RigCamera(camera.size, stills, rate, settings.get(names.get(key, ""), {}))
    asked = (document.get("control") or {}).get("rate_hz")
    return Rig(
        metadata.get("robot", ""), "", window.joints, cameras,
        None if window.sampled else rate_of(np.unique(window.state.stamps_ns)),
        float(asked) if isinstance(asked, int | float) else None, _json(metadata, "calibration"),
        _versions(metadata), metadata.get("fingerprint", ""),
    )  # fmt: skip


def rate_of(times_ns: NDArray[np.int64]) -> float | None:
    """The rate of messages [Hz]; None for fewer than five."""
    if len(times_ns) < 5 or times_ns[-1] <= times_ns[0]:
        return None
    return float((len(times_ns) - 1) / ((times_ns[-1] - times_ns[0]) / 1e9))


def _settings(peripheral: Mapping[str, Any]) -> dict[str, Any]:
    return {
        str(name): value
        for name, value in peripheral.items()
        if name not in ("name", "kind", "device", "serial", "transform", "sim", "strict")
    }


def _json(metadata: Mapping[str, str], name: str) -> Any:
    try:
        value = json.loads(metadata.get(name, "{}"))
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def _versions(metadata: Mapping[str, str]) -> dict[str, str]:
    own = {"ibrobot-core": metadata["ibrobot_version"]} if "ibrobot_version" in metadata else {}
    return {**own, **{str(name): str(each) for name, each in _json(metadata, "plugin_versions").items()}}
