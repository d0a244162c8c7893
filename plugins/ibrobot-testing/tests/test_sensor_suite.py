"""The sensor suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import time
from typing import override

import attrs
import numpy as np
import pytest
from ibrobot_testing import SensorSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeImu, FakeSensor

from ibrobot_core.api import CameraInfo, CompressedImage, Header, Imu, SensorError


class TestSensor(SensorSuite):
    timeout_s = 5.0

    @override
    def make(self, ctx):
        return FakeSensor(ctx)

    @override
    def silence(self, sensor):
        sensor.silence()


class TestImu(SensorSuite):
    timeout_s = 5.0

    @override
    def make(self, ctx):
        return FakeImu(ctx)

    @override
    def silence(self, sensor):
        sensor.silence()


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


class Thermometer(FakeImu):
    """Measures when it is read, at most every 2 ms."""

    late_ns = 0

    def read(self, timeout_s):
        if not self._open:
            raise SensorError("not open")
        clock = self._ctx.clock
        clock.sleep_until(clock.now_ns() + 2_000_000)
        return Imu(Header(clock.now_ns() - self.late_ns, "subject"))


class StampsOfAnEarlierReading(Thermometer):
    late_ns = 8_000_000


@pytest.mark.parametrize(
    ("device", "at_once", "failed"),
    [
        (Thermometer, True, set()),
        (StampsOfAnEarlierReading, True, {"stamps_are_times_of_capture"}),
        (Thermometer, False, {"stamps_are_times_of_capture", "silence_gives_none"}),
    ],
)
def test_device_that_measures_when_it_is_read_says_so(device, at_once, failed, tmp_path):
    class Suite(SensorSuite):
        measures_when_read = at_once

        @override
        def make(self, ctx):
            return device(ctx)

    assert failed_checks(Suite, tmp_path) == failed


def test_fake_waits_for_its_next_message_and_not_longer_than_its_time_out():
    context = TestImu().context()
    sensor = FakeImu(context)
    sensor.open()
    first = sensor.read(1.0)
    assert first is not None
    assert sensor.read(0.004) is None
    assert context.clock.now_ns() == first.header.stamp_ns + 4_000_000
    second = sensor.read(1.0)
    sensor.close()
    assert second is not None
    assert second.header.stamp_ns == first.header.stamp_ns + context.period_ns == context.clock.now_ns()


def test_every_check_catches_something():
    assert checks(SensorSuite) == set(WRONG.values())
