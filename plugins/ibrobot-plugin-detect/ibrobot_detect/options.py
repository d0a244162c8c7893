"""The section `detect`, the options of its detectors, and requests to its service."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.api import IbrobotError, OptionFault, Options, documented, option
from ibrobot_core.app import RequestError, Service, installed_plugins
from ibrobot_detect.detector import KIND, DetectorDescriptor

if TYPE_CHECKING:
    from ibrobot_core.api import Robot

SECTION = "detect"
FAMILIES = ("tag36h11", "tag25h9", "tag16h5", "tagStandard41h12", "tagCircle21h7")
_FURTHEST_M = 10.0


@documented
@attrs.frozen
class SceneOptions(Options):
    """Options of the detector `scene`: none."""


def _near(instance: object, attribute: attrs.Attribute[Any], value: tuple[float, ...]) -> None:
    if not all(abs(each) <= _FURTHEST_M for each in value):  # so that NaN fails it
        raise ValueError(f"must be numbers from -{_FURTHEST_M:g} to {_FURTHEST_M:g}, got {list(value)}")


@documented
@attrs.frozen
class Tag:
    """An object with a tag."""

    id: int = option(ge=0, help="number of the tag in its family")
    size: float = option(unit="m", gt=0.001, le=2, help="edge length of the tag's black square")
    xyz: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), unit="m", validator=_near,
        help="the object's origin in the tag's frame: x to the right, y up, z out of the tag",
    )  # fmt: skip
    rpy: tuple[float, float, float] = option(
        (0.0, 0.0, 0.0), unit="rad", validator=_near, help="the object's roll, pitch and yaw in the tag's frame"
    )
    object_size: tuple[float, ...] = option((), unit="m", help="the object's lengths along its axes, if they are known")


@documented
@attrs.frozen
class TagOptions(Options):
    """Options of the detector `apriltag`."""

    tags: Mapping[str, Tag] = option(help="name of an object -> its tag")
    family: str = option("tag36h11", choices=FAMILIES, help="family of the tags")
    margin: float = option(30.0, ge=0, le=255, help="least contrast of a tag's cells that counts")

    def __attrs_post_init__(self) -> None:
        if not self.tags:
            raise ValueError("tags: name at least one object, e.g. cube: {id: 3, size: 0.03}")
        numbers = [each.id for each in self.tags.values()]
        if twice := sorted({each for each in numbers if numbers.count(each) > 1}):
            raise ValueError(f"tags: several objects have tag {twice[0]}")


@documented
@attrs.frozen
class DetectOptions(Options):
    """Options of the section `detect`."""

    use: Mapping[str, Mapping[str, Any]] = option(
        factory=lambda: {"scene": {}}, help="type of a detector -> its options; `ibrobot plugins` lists the types"
    )
    transform_tolerance: float = option(
        0.5, unit="s", gt=0, le=10, help="greatest time between a picture and the pose of its camera"
    )

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check the options of each detector."""
        for type_, plain in self.use.items():
            try:
                options_of(type_, plain)
            except IbrobotError as error:
                yield OptionFault(("use", type_), str(error))


def options_of(type_: str, plain: Mapping[str, Any]) -> tuple[DetectorDescriptor, Any]:
    """A detector's descriptor, and its options.

    Raises:
        IbrobotError: for a type that is not installed, or options that do not fit.
    """
    descriptor = installed_plugins().find(KIND, type_)
    assert isinstance(descriptor, DetectorDescriptor)
    descriptor.check()
    read = Service(type_, descriptor.options, type(None)).read  # errors name the whole key
    try:
        return descriptor, read(dict(plain), Path)
    except RequestError as error:
        raise RequestError(str(error).removeprefix(f"{type_}: ")) from error


@documented
@attrs.frozen
class Find:
    """A request to `/find`."""

    name: str = option("", help="what to look for, e.g. cube; all that is known by default")
    camera: str = option("", help="look with this camera alone; with all of them by default")
    at: tuple[float, ...] = option((), unit="px", help="a place in the camera's picture, x and y: what is seen there")
    timeout: float = option(3.0, unit="s", gt=0, le=10, help="longest wait for a new picture")

    def __attrs_post_init__(self) -> None:
        if self.at and len(self.at) != 2:
            raise ValueError(f"at: give x and y, got {len(self.at)} numbers")
        if self.at and not self.camera:
            raise ValueError("at: name the camera, too")
