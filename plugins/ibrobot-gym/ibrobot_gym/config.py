"""Robot YAML of an environment, with its scene and cameras."""

from __future__ import annotations

from collections.abc import Sequence

from ibrobot_core.api import HardwareDescriptor
from ibrobot_core.app import RobotConfig, find_config, from_document, installed_plugins, load_config

RENDERED = "gym_render"
"""Peripheral whose pictures `render` returns."""


def environment_config(
    name: str,
    scene: str | None,
    cameras: Sequence[str],
    size: tuple[int, int],
    rendered: str | None,
    overrides: Sequence[str],
) -> RobotConfig:
    """Load a robot YAML with a scene and cameras.

    Args:
        name: a robot YAML, or the name of a shipped one.
        scene: the type of scene; None: that of the file.
        cameras: cameras of the scene to observe, in addition to those of the file.
        size: height and width of their pictures [px].
        rendered: camera of `render`; None without rendering.
        overrides: `path.to.key=value`, as of `ibrobot launch --set`.

    Raises:
        ConfigError: with all faults.
    """
    registry = installed_plugins()
    chosen = [f"simulation.scene={scene}"] if scene is not None else []
    config = load_config(find_config(name, registry), sim=True, overrides=[*chosen, *overrides])
    assert config.simulation is not None
    descriptor = registry.find("hardware", config.simulation.type)
    assert isinstance(descriptor, HardwareDescriptor)
    type_ = descriptor.sensors["camera"]
    names = {f"gym_{camera}": camera for camera in cameras}
    if not names and rendered is None:
        return config
    height, width = size
    camera = {"kind": "camera", "type": type_, "fps": config.contract.rate_hz, "encoding": "raw"}
    added = [{"name": name, "camera": of, "width": width, "height": height, **camera} for name, of in names.items()]
    if rendered is not None:
        added.append({"name": RENDERED, "camera": rendered, "width": 640, "height": 480, **camera})
    document = dict(config.document)
    document["peripherals"] = [*document.get("peripherals", ()), *added]
    observed = [
        {"key": f"observation.images.{of}", "peripheral": name, "align": {"strategy": "asof", "tol_ms": 100.0}}
        for name, of in names.items()
    ]
    contract = dict(document.get("contract", {}))
    document["contract"] = {**contract, "observations": [*contract.get("observations", ()), *observed]}
    return from_document(document, source=config.source, sim=True)
