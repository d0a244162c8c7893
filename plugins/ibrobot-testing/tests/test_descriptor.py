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
    Options,
    SensorDescriptor,
    StreamOptions,
)


def make(options: Any, ctx: Any) -> Never:
    raise NotImplementedError("nothing is made")


def wrong(descriptor: Descriptor[Any], **members: Any) -> Descriptor[Any]:
    return attrs.evolve(descriptor, **members)


def answering(**answers: object) -> type[Options]:
    """A class of options with these answers."""
    return type("Answering", (Options,), answers)


ARM = HardwareDescriptor("arm", make, "an arm")
EYE = SensorDescriptor("eye", make, "an eye")
FOLLOWS = ExecutorDescriptor("follows", make, "follows", StreamOptions, streams=True)


@pytest.mark.parametrize(
    "descriptor",
    [
        ARM,
        EYE,
        FOLLOWS,
        attrs.evolve(ARM, options=answering(calibration="arm", anchored=("gripper",))),
        attrs.evolve(EYE, options=answering(picture=(480, 640))),
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
        (wrong(ARM, options=answering(devices=lambda options: {"port": 1})), "devices: "),
        (wrong(ARM, options=answering(calibration="")), "calibration must be a name"),
        (wrong(ARM, options=answering(anchored="gripper")), "must be a tuple of joints, got 'gripper'"),
        (wrong(ARM, options=answering(anchored=("a", "a"))), "names a joint twice"),
        (wrong(EYE, options=answering(picture=(480, 640, 3))), "picture must be height and width"),
        (wrong(EYE, options=answering(picture=(480.0, 640))), "picture must be height and width"),
        (wrong(EYE, options=answering(picture=(0, 640))), "picture must be height and width"),
        (wrong(FOLLOWS, options=Options), "must derive from StreamOptions"),
        (wrong(FOLLOWS, options=Options, streams=False, goals="pose"), "goals is 'pose'"),
    ],
)
def test_a_wrong_member_is_found(descriptor: Descriptor[Any], what: str) -> None:
    options = Options() if what == "is not a StreamOptions" else descriptor.options()
    with pytest.raises(AssertionError, match=what):
        check_descriptor(descriptor, options)
