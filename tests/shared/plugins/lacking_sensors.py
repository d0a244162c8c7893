"""Sensors that lack something on this machine."""

from __future__ import annotations

from typing import Never

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import SensorDescriptor
from ibrobot_core.errors import MissingDependency


def no_library():
    raise MissingDependency("libdepth.so.1 is not there", apt=["libdepth1", "libusb-1.0-0"])


def bug():
    raise ZeroDivisionError("one over nothing")


def unused(options: object, ctx: object) -> Never:
    raise NotImplementedError("nothing makes one")


@hookimpl
def ibrobot_sensors():
    yield SensorDescriptor("depth", unused, "a depth camera", check=no_library)
    yield SensorDescriptor("far_depth", unused, "another one", check=no_library)
    yield SensorDescriptor("odd", unused, "an odd one", check=bug)
    yield SensorDescriptor("sound", unused, "needs nothing")
