"""Checks of descriptors, for tests of plugins."""

from __future__ import annotations

from typing import Any

from ibrobot_core.api import (
    Descriptor,
    ExecutorDescriptor,
    HardwareDescriptor,
    Options,
    SensorDescriptor,
    StreamOptions,
)


def check_descriptor(descriptor: Descriptor[Any], options: Options) -> None:
    """Check a descriptor and what its options answer before an object is created.

    Args:
        descriptor: a descriptor from the plugin's hook.
        options: options of its class, e.g. with a calibration or an image size.

    Raises:
        AssertionError: if an answer is wrong.
    """
    name = descriptor.type
    assert name, "type is empty"
    assert descriptor.summary, f"{name}: summary is empty"
    assert isinstance(options, descriptor.options), f"{name}: {options!r} is not a {descriptor.options.__name__}"
    devices = options.devices()
    assert all(isinstance(text, str) for pair in devices.items() for text in pair), f"{name}: devices: {devices!r}"
    match descriptor:
        case HardwareDescriptor():
            calibration, anchored = options.calibration, options.anchored
            assert calibration is None or (isinstance(calibration, str) and calibration), (
                f"{name}: calibration must be a name, a path or None, got {calibration!r}"
            )
            joints = isinstance(anchored, tuple) and all(isinstance(joint, str) for joint in anchored)
            assert joints, f"{name}: anchored must be a tuple of joints, got {anchored!r}"
            assert len(set(anchored)) == len(anchored), f"{name}: anchored names a joint twice: {anchored!r}"
        case SensorDescriptor():
            picture = options.picture
            assert picture is None or (
                isinstance(picture, tuple) and len(picture) == 2 and all(type(n) is int and n > 0 for n in picture)
            ), f"{name}: picture must be height and width [px] or None, got {picture!r}"
        case ExecutorDescriptor():
            assert descriptor.goals in {"trajectory", "position"}, f"{name}: goals is {descriptor.goals!r}"
            streams = issubclass(descriptor.options, StreamOptions)
            assert streams or not descriptor.streams, f"{name} streams: its options must derive from StreamOptions"
