"""The sensor suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import time
from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_testing import SensorSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeImu, FakeSensor

from ibrobot_core.api import CameraInfo, CompressedImage, Header, SensorError


class TestSensor(SensorSuite):
    timeout_s = 5.0

    @override
    def make(self, ctx):
        return FakeSensor(ctx)


class TestImu(SensorSuite):
    timeout_s = 5.0

    @override
    def make(self, ctx):
        return FakeImu(ctx)


class RelativeTopic(FakeSensor):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.topic = "camera/image_raw"


class OtherType(FakeSensor):
    message_type = CompressedImage


class NamesNoFrame(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        if image is None:
            return None
        header = attrs.evolve(image.header, frame_id=None)  # type: ignore[arg-type]
        return attrs.evolve(image, header=header)


class ReadsBeforeItIsOpen(FakeSensor):
    def __init__(self, ctx):
        super().__init__(ctx)
        self._open = True


class StampsStandStill(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and attrs.evolve(image, header=Header(1))


class StampsAhead(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and attrs.evolve(image, header=Header(image.header.stamp_ns + 10**9))


class StampsOnReading(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and attrs.evolve(image, header=attrs.evolve(image.header, stamp_ns=self._ctx.clock.now_ns()))


class RepeatsTheLastImage(FakeSensor):
    def read(self, timeout_s):
        self._last_ns = -1
        return super().read(timeout_s)


class IgnoresItsTimeOut(FakeSensor):
    """Waits longer than it was told to."""

    def read(self, timeout_s):
        image = super().read(timeout_s)
        if image is None:
            time.sleep(1.0)
        return image


class ReusesItsBuffer(FakeSensor):
    buffer = np.zeros(8 * 6 * 3, np.uint8)

    def read(self, timeout_s):
        image = super().read(timeout_s)
        if image is None:
            return None
        self.buffer[:] = image.data
        return attrs.evolve(image, data=self.buffer)


class ShortRows(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and attrs.evolve(image, step=image.width)


class HasNoFrame(FakeSensor):
    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and attrs.evolve(image, header=Header(image.header.stamp_ns))


class CutsItsJpegs(FakeSensor):
    message_type = CompressedImage

    def read(self, timeout_s):
        image = super().read(timeout_s)
        return image and CompressedImage(image.header, "jpeg", np.array([0xFF, 0xD8], np.uint8))


class OtherCameraInfo(FakeSensor):
    def latched(self):
        return (("/camera/subject/camera_info", CameraInfo(Header(), height=480, width=640)),)


class ClosesOnce(FakeSensor):
    def close(self):
        if not self._open:
            raise SensorError("not open")
        super().close()


class OpensOnce(FakeSensor):
    opened = False

    def open(self):
        if self.opened:
            raise SensorError("busy")
        self.opened = True
        super().open()


class ReadsWhileClosed(FakeSensor):
    def read(self, timeout_s):
        self._open = True
        return super().read(timeout_s)


WRONG = {
    RelativeTopic: "topic_and_type_are_declared",
    OtherType: "messages_are_of_the_declared_type",
    NamesNoFrame: "messages_are_of_the_declared_type",
    ReadsBeforeItIsOpen: "refuses_reading_while_closed",
    StampsStandStill: "stamps_strictly_increase",
    StampsAhead: "stamps_strictly_increase",
    StampsOnReading: "stamps_are_times_of_capture",
    RepeatsTheLastImage: "silence_gives_none",
    IgnoresItsTimeOut: "reading_ends_with_its_time_out",
    ReusesItsBuffer: "messages_stay_as_they_were",
    ShortRows: "images_are_whole",
    HasNoFrame: "images_are_whole",
    CutsItsJpegs: "images_are_whole",
    OtherCameraInfo: "latched_messages_fit",
    ClosesOnce: "close_is_safe_at_any_time",
    OpensOnce: "close_is_safe_at_any_time",
    ReadsWhileClosed: "refuses_reading_while_closed",
}

ALONE = {StampsOnReading, IgnoresItsTimeOut, HasNoFrame}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestSensor):
        @override
        def make(self, ctx):
            return wrong(ctx)

    failed = failed_checks(Suite, tmp_path)
    assert caught_by in failed
    if wrong in ALONE:
        assert set(failed) == {caught_by}, "no other check catches it"


def test_every_check_catches_something():
    assert checks(SensorSuite) == set(WRONG.values())
