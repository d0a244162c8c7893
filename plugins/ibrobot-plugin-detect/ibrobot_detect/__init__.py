"""The plugin's hooks: the kind `detector`, the detectors `scene` and `apriltag`, and the section `detect`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ibrobot_core.api import Descriptor, Late, hookimpl
from ibrobot_core.app import Kind, SectionDescriptor
from ibrobot_detect.detector import KIND, DetectorDescriptor
from ibrobot_detect.options import SECTION, DetectOptions, SceneOptions, TagOptions


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Detectors."""
    yield Kind(KIND, "ibrobot_detectors", DetectorDescriptor)


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    yield Descriptor(KIND, Late("ibrobot_detect.fakes:FakeDetector"), "things of two colours on a table")


@hookimpl
def ibrobot_detectors() -> Iterable[DetectorDescriptor]:
    """The detectors `scene` and `apriltag`."""
    yield DetectorDescriptor(
        "scene",
        options=SceneOptions,
        make=Late("ibrobot_detect.scene:SceneDetector"),
        pictures=False,
        summary="objects of the section `world`, which in simulation has those of the scene",
    )
    yield DetectorDescriptor(
        "apriltag",
        options=TagOptions,
        make=Late("ibrobot_detect.tags:TagDetector"),
        summary="objects with AprilTags, in pictures of calibrated cameras whose place is known",
    )


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """What finds objects."""
    yield SectionDescriptor(
        type=SECTION,
        options=DetectOptions,
        make=Late("ibrobot_detect.finder:Finder"),
        summary="the service /find: objects by name, or by a place in a picture, with their poses",
    )
