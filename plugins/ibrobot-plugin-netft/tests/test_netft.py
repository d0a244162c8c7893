"""The sensor on an emulated device: conformance, packets, faults, and a run that is recorded and converted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, override

import ibrobot_netft
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_netft import NetFtOptions
from ibrobot_netft.emulator import EmulatedNetFt
from ibrobot_netft.protocol import START, Record, command_of, request
from ibrobot_netft.sensor import NetFt
from ibrobot_sensor_messages.messages import WrenchStamped
from ibrobot_testing import SensorSuite, check_descriptor
from ibrobot_testing.contexts import host_context

from ibrobot_core.api import Context, Sensor, SensorError

PATIENCE_S = 30.0
number = st.integers(0, 2**32 - 1)
counts = st.tuples(*[st.integers(-(2**31), 2**31 - 1)] * 6)


class TestNetFt(SensorSuite):
    @pytest.fixture(autouse=True)
    def _device(self) -> Iterator[None]:
        with EmulatedNetFt() as self.device:
            yield

    @override
    def context(self) -> Context:
        return host_context("wrist")

    @override
    def make(self, ctx: Context) -> Sensor:
        return NetFt(NetFtOptions("127.0.0.1", self.device.port, silence=PATIENCE_S), ctx)

    @override
    def trigger(self, sensor: Sensor, ctx: Context) -> None:
        super().trigger(sensor, ctx)
        assert isinstance(sensor, NetFt)
        with sensor._changed:  # the device may not have heard of it yet
            while sensor._newest is None:
                self.device.measure((0, 0, 1, 0, 0, 0))
                sensor._changed.wait(0.05)


@contextmanager
def opened(**changes: Any) -> Iterator[tuple[NetFt, EmulatedNetFt]]:
    with EmulatedNetFt() as device:
        given: dict[str, Any] = {"host": "127.0.0.1", "port": device.port, "silence": PATIENCE_S, **changes}
        options = NetFtOptions(**given)
        sensor = NetFt(options, host_context("wrist"))
        sensor.open()
        try:
            assert device.wait(PATIENCE_S)
            yield sensor, device
        finally:
            sensor.close()


def along_z(sensor: NetFt) -> float:
    """The next force [N]."""
    message = sensor.read(PATIENCE_S)
    assert message is not None
    return message.wrench.force.z


def test_what_the_descriptor_says_is_what_the_sensor_publishes() -> None:
    (descriptor,) = ibrobot_netft.ibrobot_sensors()
    options = NetFtOptions("sensor.lab")
    check_descriptor(descriptor, options)
    sensor = NetFt(options, host_context("wrist"))
    assert sensor.topic == descriptor.topic.format(name="wrist")
    assert sensor.message_type.ros_type == descriptor.message


def test_known_bytes() -> None:
    assert request(START).hex(" ") == "12 34 00 02 00 00 00 00"
    record = Record.decode(
        bytes.fromhex("00000001 00000007 00000000 000f4240 fff0bdc0 00000000 00000000 00000000 000003e8")
    )
    assert (record.sequence, record.sample, record.counts) == (1, 7, (1_000_000, -1_000_000, 0, 0, 0, 1000))


@given(number, number, number, counts)
def test_a_record_survives_its_packet(sequence: int, sample: int, status: int, values: tuple[int, ...]) -> None:
    x, y, z, a, b, c = values
    record = Record(sequence, sample, status, (x, y, z, a, b, c))
    assert Record.decode(record.encode()) == record


@given(st.binary(max_size=80))
def test_any_bytes_are_a_record_or_refused(data: bytes) -> None:
    try:
        assert Record.decode(data).encode() == data
    except SensorError:
        assert len(data) != 36
    assert command_of(data) is None or data[:2] == b"\x12\x34"


def test_counts_become_newtons_and_newton_metres() -> None:
    with opened(counts_per_force=1000.0, counts_per_torque=100.0, frame="tool") as (sensor, device):
        device.measure((1000, -2000, 500, 10, 20, -30))
        message = sensor.read(PATIENCE_S)
    assert message is not None
    force, torque = message.wrench.force, message.wrench.torque
    assert (force.x, force.y, force.z) == (1.0, -2.0, 0.5)
    assert (torque.x, torque.y, torque.z) == (0.1, 0.2, -0.3)
    assert message.header.frame_id == "tool"


def test_late_double_and_damaged_records_are_left_out() -> None:
    with opened() as (sensor, device):
        device.measure((0, 0, 3_000_000, 0, 0, 0), sequence=3)
        assert along_z(sensor) == 3.0
        device.measure((0, 0, 2_000_000, 0, 0, 0), sequence=2)
        device.measure((0, 0, 3_500_000, 0, 0, 0), sequence=3)
        device.send(b"\x00" * 35)
        device.measure((0, 0, 4_000_000, 0, 0, 0), sequence=4)
        assert along_z(sensor) == 4.0


def test_numbers_of_records_may_wrap() -> None:
    with opened() as (sensor, device):
        device.measure((0, 0, 1_000_000, 0, 0, 0), sequence=2**31 - 1)
        assert along_z(sensor) == 1.0
        device.measure((0, 0, 1_500_000, 0, 0, 0), sequence=2**32 - 2)
        assert along_z(sensor) == 1.5
        device.measure((0, 0, 2_000_000, 0, 0, 0), sequence=1)
        assert along_z(sensor) == 2.0


def test_wrong_values_are_an_error_until_the_sensor_measures_again() -> None:
    with opened() as (sensor, device):
        device.measure(status=0x80010000)
        with pytest.raises(SensorError, match=r"force sensor wrist .*: it reports the error 0x80010000"):
            sensor.read(PATIENCE_S)
        device.measure((0, 0, 1_000_000, 0, 0, 0))
        while (message := read_or_none(sensor)) is None:
            continue
        assert message.wrench.force.z == 1.0


def test_a_sensor_without_power_is_an_error_and_is_asked_again_when_it_is_back() -> None:
    with opened(silence=0.3) as (sensor, device):
        device.silent = True
        with pytest.raises(SensorError, match=r"no record for 0\.3 s; check its power and its cable"):
            sensor.read(PATIENCE_S)
        device._listener = None  # it has forgotten who asked
        device._asked.clear()
        device.silent = False
        assert device.wait(PATIENCE_S)
        device.measure((0, 0, 1_000_000, 0, 0, 0))
        while (message := read_or_none(sensor)) is None:
            device.measure((0, 0, 1_000_000, 0, 0, 0))
        assert message.wrench.force.z == 1.0


def read_or_none(sensor: NetFt) -> WrenchStamped | None:
    try:
        return sensor.read(PATIENCE_S)
    except SensorError:
        return None


def test_the_stream_ends_with_the_sensor() -> None:
    with EmulatedNetFt() as device:
        sensor = NetFt(NetFtOptions("127.0.0.1", device.port), host_context("wrist"))
        sensor.open()
        assert device.wait(PATIENCE_S)
        sensor.close()
        assert device.stopped.wait(PATIENCE_S)


def test_a_host_that_does_not_exist_is_an_error() -> None:
    sensor = NetFt(NetFtOptions("no-such-host.invalid"), host_context("wrist"))
    with pytest.raises(SensorError, match=r"no-such-host\.invalid:49152\): .*check host"):
        sensor.open()
