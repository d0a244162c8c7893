"""Path constraints of a tool: what holds on the whole way of a goal, and while a device moves the tool.

Named like MoveIt's `path_constraints`. Nothing here imports NumPy.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import attrs

from ibrobot_core.api import documented, option

type Triple = tuple[float, float, float]
AxisName = Literal["x", "y", "z", "-x", "-y", "-z"]

_NAMED: dict[AxisName, Triple] = {
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "-z": (0.0, 0.0, -1.0),
}
AXES: tuple[AxisName, ...] = tuple(_NAMED)
FURTHEST_M = 1e6
"""Larger lengths are refused."""


@documented
@attrs.frozen
class PathConstraints:
    """What holds for the tool on the whole way, start and goal included: upright, in a region, a point in view."""

    upright: float | None = option(
        None, unit="rad", gt=0, lt=math.pi, help="largest angle between `upright_axis` and the vertical"
    )
    upright_axis: tuple[float, float, float] | AxisName | None = option(
        None, help="axis of the tool that points up, e.g. z, -x or [0, 0.7, 0.7]; by default the nearest at the start"
    )
    region: tuple[float, float, float, float, float, float] | None = option(
        None, unit="m", help="box that the tool stays in: lower x, y, z, upper x, y, z, in the base frame"
    )
    view: tuple[float, float, float] | None = option(
        None, unit="m", help="point in the base frame that a camera on the tool keeps in view"
    )
    view_angle: float = option(
        0.35, unit="rad", gt=0, lt=math.pi, help="largest angle between the camera's axis and the way to `view`"
    )
    view_axis: tuple[float, float, float] | AxisName = option("z", help="axis of the tool along which the camera looks")
    view_from: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), unit="m", help="position of the camera in the frame of the tool"
    )

    def __attrs_post_init__(self) -> None:
        if self.upright_axis is not None and self.upright is None:
            raise ValueError("upright_axis needs upright, the largest angle from the vertical")
        if self.view is None:
            for field in attrs.fields(PathConstraints):
                if field.name.startswith("view_") and getattr(self, field.name) != field.default:
                    raise ValueError(f"{field.name} needs view, the point to keep in view")
        if self.upright is None and self.region is None and self.view is None:
            raise ValueError(f"path constraints have at least one of {', '.join(KINDS)}; there is none")
        for name in ("upright_axis", "region", "view", "view_axis", "view_from"):
            values = getattr(self, name)
            numbers = () if values is None or isinstance(values, str) else values
            if not all(abs(each) <= FURTHEST_M for each in numbers):  # NaN fails it, too
                raise ValueError(f"{name} must be numbers from -{FURTHEST_M:g} to {FURTHEST_M:g}, got {list(numbers)}")
            if name.endswith("_axis") and numbers and not math.hypot(*numbers) > 0:
                raise ValueError(f"{name} has no length; give a direction, e.g. z, or 0, 0, 1")
        if self.region is not None:
            for axis, low, high in zip("xyz", self.region[:3], self.region[3:], strict=True):
                if not low < high:
                    raise ValueError(f"region: the lower {axis} is {low:g}, must be below the upper {axis}, {high:g}")

    @property
    def text(self) -> str:
        """The constraints as in the text of a goal."""
        return " ".join(
            f"{name}={_words(value)}"
            for name, value in attrs.asdict(self).items()
            if value is not None and value != getattr(attrs.fields(PathConstraints), name).default
        )


KINDS = ("upright", "region", "view")
"""Keys of which at least one is given."""
CONSTRAINT_KEYS = tuple(field.name for field in attrs.fields(PathConstraints))


def direction(axis: Triple | AxisName) -> Triple:
    """The unit vector of an axis of the tool."""
    if isinstance(axis, str):
        return _NAMED[axis]
    largest = max(map(abs, axis))  # the squares of small and large numbers would underflow and overflow
    x, y, z = (each / largest for each in axis)
    length = math.hypot(x, y, z)
    return x / length, y / length, z / length


def _words(value: Any) -> str:
    if isinstance(value, tuple):
        return ",".join(repr(float(each)) for each in value)
    return value if isinstance(value, str) else repr(float(value))
