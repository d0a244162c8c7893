"""Frames: known bytes, round trips, and what is no frame."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_damiao import protocol
from ibrobot_damiao.emulator import EmulatedMotor
from ibrobot_damiao.emulator.serve import frame_of, line_of, lines
from ibrobot_damiao.protocol import ERRORS, OFF, ON, Feedback, MitCommand, Ranges, Register

from ibrobot_core.api import HardwareError

DM4310 = Ranges(12.5, 30.0, 10.0)
ranges = st.builds(Ranges, st.floats(0.5, 100), st.floats(0.5, 300), st.floats(0.5, 300))
share = st.floats(-1, 1)


def test_known_bytes() -> None:
    """Made by the vendor's formula for a DM4310: 0 is 0x7FFF or 0x800, rounded, kp 50 of 500 is 0x19A, kd 1 of 5 is
    0x333."""
    assert MitCommand(0.0, 50.0, 1.0).encode(DM4310).hex(" ") == "80 00 80 01 9a 33 38 00"
    assert MitCommand(-12.5, 0.0, 0.0, -30.0, -10.0).encode(DM4310).hex(" ") == "00 00 00 00 00 00 00 00"
    assert MitCommand(12.5, 500.0, 5.0, 30.0, 10.0).encode(DM4310).hex(" ") == "ff ff ff ff ff ff ff ff"
    assert protocol.command(protocol.ENABLE).hex(" ") == "ff ff ff ff ff ff ff fc"
    assert protocol.refresh(3).hex(" ") == "03 00 cc 00 00 00 00 00"
    assert protocol.save(3).hex(" ") == "03 00 aa 01 00 00 00 00"
    assert Register(5, protocol.MODE, 1, write=True).encode().hex(" ") == "05 00 55 0a 01 00 00 00"
    assert Register(5, protocol.MAX_POSITION, 12.5).encode().hex(" ") == "05 00 33 15 00 00 48 41"


@given(ranges, share, share, share, st.floats(0, 500), st.floats(0, 5))
def test_a_command_survives_its_frame_up_to_a_step(
    span: Ranges, position: float, velocity: float, torque: float, kp: float, kd: float
) -> None:
    made = MitCommand(position * span.position, kp, kd, velocity * span.velocity, torque * span.torque)
    read = MitCommand.decode(made.encode(span), span)
    assert read.position == pytest.approx(made.position, abs=1.01 * span.position / 65535)
    for value, kept, reach in (
        (made.velocity, read.velocity, 2 * span.velocity),
        (made.torque, read.torque, 2 * span.torque),
        (made.kp, read.kp, 500),
        (made.kd, read.kd, 5),
    ):
        assert kept == pytest.approx(value, abs=0.51 * reach / 4095)
    assert read.encode(span) == made.encode(span)


@given(ranges, share, share, share, st.sampled_from([OFF, ON, *ERRORS]), st.integers(0, 15), st.integers(0, 255))
def test_feedback_survives_its_frame_up_to_a_step(
    span: Ranges, position: float, velocity: float, torque: float, state: int, motor: int, celsius: int
) -> None:
    made = Feedback(
        motor, state, position * span.position, velocity * span.velocity, torque * span.torque, 30.0, celsius
    )
    read = Feedback.decode(made.encode(span), span)
    assert (read.motor, read.state, read.driver, read.coil) == (motor, state, 30.0, celsius)
    assert read.position == pytest.approx(made.position, abs=1.01 * span.position / 65535)
    assert read.velocity == pytest.approx(made.velocity, abs=1.01 * span.velocity / 4095)
    assert read.torque == pytest.approx(made.torque, abs=1.01 * span.torque / 4095)


@given(st.binary(max_size=12))
def test_any_bytes_are_feedback_or_refused(data: bytes) -> None:
    try:
        feedback = Feedback.decode(data, DM4310)
    except HardwareError:
        assert len(data) != 8 or data[0] >> 4 not in (OFF, ON, *ERRORS)
    else:
        assert abs(feedback.position) <= 12.5


@given(st.integers(1, 0x7E), st.sampled_from(protocol.WHOLE), st.integers(0, 2**32 - 1), st.booleans())
def test_a_register_survives_its_frame(motor: int, register: int, value: int, write: bool) -> None:
    made = Register(motor, register, value, write)
    assert Register.decode(made.encode()) == made


@given(st.binary(max_size=12))
def test_any_bytes_are_a_register_or_none(data: bytes) -> None:
    register = Register.decode(data)
    assert register is None or register.encode()[:4] == data[:4]


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_a_frame_survives_the_line_of_an_adapter(arbitration_id: int, data: bytes) -> None:
    pending = bytearray(line_of((arbitration_id, data)))
    (line,) = lines(pending)
    assert frame_of(line) == (arbitration_id, data)
    assert not pending


@given(st.lists(st.binary(max_size=40)))
def test_any_bytes_from_a_program_leave_an_adapter_at_work(chunks: list[bytes]) -> None:
    pending = bytearray()
    for chunk in chunks:
        pending += chunk
        for line in lines(pending):
            frame = frame_of(line)
            assert frame is None or len(frame[1]) <= 8
        assert len(pending) <= 64
    pending += b"\rt0018FFFFFFFFFFFFFFFC\r"
    assert frame_of([*lines(pending)][-1]) == (1, b"\xff" * 7 + b"\xfc")


@given(st.lists(st.tuples(st.sampled_from([1, 2, 0x7FF]), st.binary(max_size=8)), max_size=20))
def test_an_emulated_motor_survives_any_frames(frames: list[tuple[int, bytes]]) -> None:
    motor = EmulatedMotor(1)
    for i, (arbitration_id, data) in enumerate(frames):
        for _, answer in motor.receive(arbitration_id, data, float(i)):
            assert len(answer) == 8
