"""The scenes of the simulation; importing this package imports no MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ibrobot_mujoco.gl import from_module
from ibrobot_mujoco.scene import SceneConfig, SceneDescriptor
from ibrobot_mujoco.scenes.options import (
    DrawerOptions,
    HandoverOptions,
    PickCubeOptions,
    PushOptions,
    SceneOptions,
    SortOptions,
    StackOptions,
)


def _descriptor(type_: str, name: str, options: type[Any], summary: str, module: str = "") -> SceneDescriptor:
    make = from_module(f"scenes.{module or type_}", name)
    return SceneDescriptor(type=type_, options=options, summary=summary, make=make)


SCENES: Mapping[str, SceneDescriptor] = {
    each.type: each
    for each in (
        _descriptor("empty", "TableScene", SceneOptions, "an empty table, without a task", "table"),
        _descriptor("pick_cube", "PickCube", PickCubeOptions, "a cube and a bin: put the cube into the bin"),
        _descriptor("push", "Push", PushOptions, "a block and a goal on the table: push the block onto the goal"),
        _descriptor("stack", "Stack", StackOptions, "two cubes: put the smaller one on the other"),
        _descriptor("drawer", "Drawer", DrawerOptions, "a closed drawer: open it"),
        _descriptor("handover", "Handover", HandoverOptions, "a bar: hand it from the left arm to the right one"),
        _descriptor("sort", "Sort", SortOptions, "red and blue cubes: put each into the bin of its colour"),
    )
}
"""Type -> descriptor of the scenes of this package."""


def scene(type_: str = "pick_cube", **options: Any) -> SceneConfig:
    """A scene of this package for `MujocoOptions.scene`, e.g. `scene("stack", light=(0.5, 1.5))`."""
    descriptor = SCENES[type_]
    return SceneConfig(type=type_, options=descriptor.options(**options), descriptor=descriptor)
