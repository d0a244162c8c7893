"""`check_descriptor` finds wrong members, and accepts right ones."""

from __future__ import annotations

from typing import Any, Never

import attrs
import pytest
from ibrobot_testing import check_descriptor

from ibrobot_core.api import (
    Descriptor,
    ExecutorDescriptor,
    HardwareDescriptor,
    NoOptions,
    SensorDescriptor,
    StreamOptions,
)


def make(options: Any, ctx: Any) -> Never:
    raise NotImplementedError("nothing is made")


def wrong(descriptor: Descriptor[Any], **members: Any) -> Descriptor[Any]:
    return attrs.evolve(descriptor, **members)


ARM = HardwareDescriptor("arm", make, "an arm")
EYE = SensorDescriptor("eye", make, "an eye")
FOLLOWS = ExecutorDescriptor("follows", make, "follows", StreamOptions, streams=True)


@pytest.mark.parametrize(
    "descriptor",
    [
        ARM,
        EYE,
        FOLLOWS,
        attrs.evolve(ARM, calibration=lambda options: "arm", anchored=lambda options: ("gripper",)),
        attrs.evolve(EYE, picture=lambda options: (480, 640)),
        ExecutorDescriptor("grips", make, "grips", goals="position"),
    ],
)
def test_right_descriptors_pass(descriptor: Descriptor[Any]) -> None:
    check_descriptor(descriptor, descriptor.options())


@pytest.mark.parametrize(
    ("descriptor", "what"),
    [
        (wrong(ARM, summary=""), "summary is empty"),
        (wrong(ARM, options=StreamOptions), "is not a StreamOptions"),
        (wrong(ARM, devices=lambda options: {"port": 1}), "devices: "),
        (wrong(ARM, calibration=lambda options: ""), "calibration must be a name"),
        (wrong(ARM, anchored=lambda options: "gripper"), "must be a tuple of joints, got 'gripper'"),
        (wrong(ARM, anchored=lambda options: ("a", "a")), "names a joint twice"),
        (wrong(EYE, picture=lambda options: (480, 640, 3)), "picture must be height and width"),
        (wrong(EYE, picture=lambda options: (480.0, 640)), "picture must be height and width"),
        (wrong(EYE, picture=lambda options: (0, 640)), "picture must be height and width"),
        (wrong(FOLLOWS, options=NoOptions), "must derive from StreamOptions"),
        (wrong(FOLLOWS, options=NoOptions, streams=False, goals="pose"), "goals is 'pose'"),
    ],
)
def test_a_wrong_member_is_found(descriptor: Descriptor[Any], what: str) -> None:
    with pytest.raises(AssertionError, match=what):
        check_descriptor(descriptor, NoOptions())
