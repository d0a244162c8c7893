"""The conformance suite of sensors."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from typing import Any, ClassVar

import attrs
import numpy as np
import pytest

from ibrobot_core.api import MESSAGE_TYPES, CameraInfo, CompressedImage, Context, Image, Message, Sensor, SensorError
from ibrobot_core.app import installed_plugins
from ibrobot_testing.suite import Suite

_BYTES_PER_PIXEL = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "mono16": 2, "16UC1": 2, "32FC1": 4}


class SensorSuite(Suite[Sensor]):
    """Checks of every `Sensor`. A driver uses a fake of its device."""

    timeout_s: ClassVar[float] = 30.0
    """How long a check waits for an expected message [s]."""
    measures_when_read: ClassVar[bool] = False
    """Whether `read` itself measures, e.g. a register of a chip or a file, so that no message can be older."""

    def trigger(self, sensor: Sensor, ctx: Context) -> None:
        """Make the device capture again, at a later time; by default one control period passes."""
        ctx.clock.sleep_until(ctx.clock.now_ns() + ctx.period_ns)

    def silence(self, sensor: Sensor) -> None:
        """Make the device stop capturing; override it for a device that captures without `trigger`.

        No device stops whose `measures_when_read` is true.
        """

    def opened(self, *, again: bool = False) -> AbstractContextManager[tuple[Sensor, Context]]:
        """An open sensor with its context; for `again` see `in_use`."""
        return self.in_use(lambda sensor: sensor.open(), lambda sensor: sensor.close(), again=again)

    def _next(self, sensor: Sensor, ctx: Context) -> Any:
        self.trigger(sensor, ctx)
        message = sensor.read(self.timeout_s)
        assert message is not None, f"no message within {self.timeout_s} s"
        return message

    def test_topic_and_type_are_declared(self) -> None:
        """`topic` begins with / and `message_type` is one of the messages, before `open`."""
        sensor = self.make(self.context())
        assert sensor.topic.startswith("/")
        assert MESSAGE_TYPES.get(sensor.message_type.ros_type) is sensor.message_type

    def test_messages_are_of_the_declared_type(self) -> None:
        """Every message is a `message_type`, and all of its fields have a value: codecs and bags take no None."""
        with self.opened() as (sensor, ctx):
            for _ in range(3):
                message = self._next(sensor, ctx)
                assert type(message) is sensor.message_type
                assert not (empty := _empty(message)), f"{', '.join(empty)} of the message is None"

    def test_stamps_strictly_increase(self) -> None:
        """Stamps increase with each message and are not in the future."""
        with self.opened() as (sensor, ctx):
            previous = -1
            for _ in range(5):
                stamp_ns = self._next(sensor, ctx).header.stamp_ns
                assert type(stamp_ns) is int
                assert previous < stamp_ns <= ctx.clock.now_ns()
                previous = stamp_ns

    def test_stamps_are_times_of_capture(self) -> None:
        """A message that is read late has the stamp of its capture."""
        with self.opened() as (sensor, ctx):
            self._next(sensor, ctx)
            self.trigger(sensor, ctx)
            self.silence(sensor)
            silent_ns = ctx.clock.now_ns()
            ctx.clock.sleep_until(asked_ns := silent_ns + ctx.period_ns // 2)
            message: Any = sensor.read(0.01)
            if message is None:
                pytest.skip("the device keeps no message that was not read")
            stamp_ns = message.header.stamp_ns
            if self.measures_when_read:
                assert stamp_ns >= asked_ns, "the stamp is older than the measurement, which `read` makes"
            else:
                assert stamp_ns <= silent_ns, (
                    "the stamp is not the time of capture; for a device that measures in `read`, set measures_when_read"
                )

    def test_silence_gives_none(self) -> None:
        """A device that has stopped capturing returns None, never its last message with a new stamp."""
        if self.measures_when_read:
            pytest.skip("measures when it is read")
        with self.opened() as (sensor, ctx):
            self._next(sensor, ctx)
            self.silence(sensor)
            silent = 0
            for _ in range(100):  # earlier messages may still arrive
                silent = silent + 1 if sensor.read(0.01) is None else 0
                if silent == 3:
                    return
            pytest.fail("messages come though the device captures nothing")

    def test_reading_ends_with_its_time_out(self) -> None:
        """`read` of a device that captures nothing returns after its time-out, at the latest after `timeout_s`."""
        with self.opened() as (sensor, ctx):
            self._next(sensor, ctx)
            self.silence(sensor)
            with ThreadPoolExecutor(1) as pool:
                for _ in range(5):  # earlier messages may still arrive
                    reading = pool.submit(sensor.read, 0.01)
                    done, _ = wait([reading], self.timeout_s / 10)
                    if not done:
                        sensor.close()  # ends the call, if anything does
                    assert done, f"read(0.01) still waits after {self.timeout_s / 10:g} s"

    def test_messages_stay_as_they_were(self) -> None:
        """A message does not change when the next one is read."""
        with self.opened() as (sensor, ctx):
            first = self._next(sensor, ctx)
            arrays = {name: value.copy() for name, value in _arrays(first).items()}
            for _ in range(3):
                self._next(sensor, ctx)
            for name, value in _arrays(first).items():
                np.testing.assert_array_equal(value, arrays[name], err_msg=f"{name} changed")

    def test_images_are_whole(self) -> None:
        """An image has `height` rows of `step` bytes, each with room for `width` pixels; a compressed one decodes.

        It names the frame of its camera, so that others know where it was taken.
        """
        with self.opened() as (sensor, ctx):
            image = _decoded(self._next(sensor, ctx))
            if not isinstance(image, Image):
                pytest.skip("gives no images")
            assert image.header.frame_id, "names no frame: give its header a frame_id, e.g. NAME_optical_frame"
            assert image.encoding in _BYTES_PER_PIXEL
            assert image.height > 0
            assert image.step >= image.width * _BYTES_PER_PIXEL[image.encoding] > 0
            assert image.data.shape == (image.height * image.step,)

    def test_latched_messages_fit(self) -> None:
        """Latched messages have their own topics; a CameraInfo has the size of the images."""
        with self.opened() as (sensor, ctx):
            message = _decoded(self._next(sensor, ctx))
            for topic, latched in sensor.latched():
                assert topic.startswith("/")
                assert topic != sensor.topic
                assert isinstance(latched, Message)
                if isinstance(latched, CameraInfo) and isinstance(message, Image):
                    assert (latched.height, latched.width) == (message.height, message.width)

    def test_close_is_safe_at_any_time(self) -> None:
        """`close` may be called before `open` and twice; `open` works again afterwards."""
        with self.opened(again=True) as (sensor, ctx):
            self._next(sensor, ctx)

    def test_refuses_reading_while_closed(self) -> None:
        """`read` raises SensorError before `open` and after `close`."""
        with pytest.raises(SensorError):
            self.make(self.context()).read(0.01)
        with self.opened() as (sensor, _):
            pass
        with pytest.raises(SensorError):
            sensor.read(0.01)


def _empty(value: Any, path: str = "") -> list[str]:
    """The paths of a message at which there is None."""
    if value is None:
        return [path]
    if not attrs.has(type(value)):
        return []
    fields = ((each.name, getattr(value, each.name)) for each in attrs.fields(type(value)))
    return [place for name, inner in fields for place in _empty(inner, f"{path}.{name}" if path else name)]


def _decoded(message: Message) -> Message:
    return installed_plugins().decode(message) if isinstance(message, CompressedImage) else message


def _arrays(message: Message) -> dict[str, Any]:
    names = (name for name in dir(message) if not name.startswith("_"))
    return {name: value for name in names if isinstance(value := getattr(message, name), np.ndarray)}
