"""Joint logs as episodes: states, commands where a contract is given, and unreadable logs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_jointlog import ibrobot_readers
from ibrobot_jointlog.log import header, read_log, row
from ibrobot_testing import make_robot

from ibrobot_core.api import (
    ActionPart,
    Contract,
    EpisodeAddress,
    EpisodeReader,
    Float64MultiArray,
    JointState,
    RecorderError,
    ns,
)

JOINTS = make_robot().joint_names
WAVE = np.array([[0.1 * i, -0.2 * i, 0.3, 0.0, 0.01 * i, 0.5] for i in range(5)])
"""Positions at 2.0, 2.1, … 2.4 s."""


def write_log(path: Path, joints: tuple[str, ...] = JOINTS) -> Path:
    columns = [JOINTS.index(joint) for joint in joints]
    text, checksum = header(joints)
    for i, positions in enumerate(WAVE):
        line, checksum = row(ns(2.0 + 0.1 * i), positions[columns], checksum)
        text += line
    path.write_text(text)
    return path


def contract(*joints: tuple[str, ...]) -> Contract:
    """A contract with an action for each group of joints."""
    kind = Float64MultiArray.ros_type
    parts = [ActionPart("action", f"/group_{i}/commands", kind, "hold", each) for i, each in enumerate(joints)]
    return Contract(30.0, (), tuple(parts))


def read(path: Path, known: Contract | None = None) -> EpisodeReader:
    (descriptor,) = ibrobot_readers()
    assert descriptor.reads(path)
    provenance = {"contract": json.dumps(known.canonical())} if known is not None else {}
    return descriptor.make(EpisodeAddress.of(path, provenance))


@pytest.mark.parametrize("joints", [JOINTS, JOINTS[::-1]])
def test_log_has_the_commands_of_the_contract(tmp_path: Path, joints: tuple[str, ...]):
    known = contract(JOINTS[:5], JOINTS[5:])
    found = list(read(write_log(tmp_path / "wave.csv", joints), known).messages())
    for topic, columns in (("/group_0/commands", slice(5)), ("/group_1/commands", slice(5, 6))):
        stamps = [each.received_ns for each in found if each.topic == topic]
        assert [stamp - stamps[0] for stamp in stamps] == [ns(0.1 * i) for i in range(5)]
        commands = [each.message for each in found if each.topic == topic]
        data = [each.data for each in commands if isinstance(each, Float64MultiArray)]
        np.testing.assert_array_equal(data, WAVE[:, columns])
    states = [each.message for each in found if isinstance(each.message, JointState)]
    assert {each.name for each in states} == {joints}
    np.testing.assert_array_equal([each.position for each in states], WAVE[:, [JOINTS.index(each) for each in joints]])


def test_log_without_a_contract_has_no_commands(tmp_path: Path):
    reader = read(write_log(tmp_path / "wave.csv"))
    assert list(reader.summary().topics) == ["/joint_states"]
    assert {each.topic for each in reader.messages()} == {"/joint_states"}


def test_joint_of_the_contract_that_the_log_lacks_is_named(tmp_path: Path):
    path = write_log(tmp_path / "wave.csv", JOINTS[:5])
    with pytest.raises(RecorderError, match=r"wave\.csv:1: joint 'gripper' of /group_0/commands is missing"):
        read(path, contract(JOINTS))


@given(at=st.integers(0, 10_000), bit=st.integers(0, 7))
def test_no_flipped_bit_goes_unnoticed(tmp_path_factory: pytest.TempPathFactory, at: int, bit: int):
    path = write_log(tmp_path_factory.mktemp("log") / "wave.csv")
    whole = bytearray(path.read_bytes())
    whole[at % len(whole)] ^= 1 << bit
    path.write_bytes(whole)
    with pytest.raises(RecorderError):
        read_log(path)


@given(size=st.integers(0, 10_000))
def test_a_log_that_was_cut_is_refused_or_has_whole_lines(tmp_path_factory: pytest.TempPathFactory, size: int):
    path = write_log(tmp_path_factory.mktemp("log") / "wave.csv")
    whole = path.read_bytes()
    part = whole[: size % len(whole)]
    path.write_bytes(part)
    if part.endswith(b"\n") and part.count(b"\n") > 1:
        np.testing.assert_array_equal(read_log(path).positions, WAVE[: part.count(b"\n") - 1])
    else:
        with pytest.raises(RecorderError):
            read_log(path)


def test_a_lost_line_is_found(tmp_path: Path):
    path = write_log(tmp_path / "wave.csv")
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2] + lines[3:]))
    with pytest.raises(RecorderError, match=r"wave\.csv:3: the line or one before it was changed: crc32 is"):
        read_log(path)


def test_other_files_are_no_joint_logs(tmp_path: Path):
    (descriptor,) = ibrobot_readers()
    (tmp_path / "table.csv").write_text("a,b\n1,2\n")
    (tmp_path / "folder").mkdir()
    assert not descriptor.reads(tmp_path / "table.csv")
    assert not descriptor.reads(tmp_path / "folder")


NUMBERS = ",0,0,0,0,0,0\n"
HEADER = f"time_s,{','.join(JOINTS)}\n"
BAD = {
    "no joint": ("time_s,\n", "1: the header begins with 'time_s', must be time_s,JOINT,…"),
    "joint twice": (HEADER.replace("elbow_flex", "gripper"), "1: joint 'gripper' has 2 columns, must have one"),
    "no rows": (HEADER, "1: has no row after the header"),
    "short row": (HEADER + "0" + NUMBERS + "1,0,0\n", "3: 3 values, must be 7 as in the header"),
    "blank row": (HEADER + "0" + NUMBERS + "\n" + "1" + NUMBERS, "3: 1 values, must be 7 as in the header"),
    "text": (HEADER + "0,0,x,0,0,0,0\n", "2: shoulder_lift is 'x', must be a number"),
    "not finite": (HEADER + "0" + NUMBERS + "1,0,0,0,0,nan,0\n", "3: wrist_roll is nan, must be finite"),
    "time not finite": (HEADER + "inf" + NUMBERS, "2: time_s is inf, must be finite"),
    "time stands": (HEADER + "1" + NUMBERS + "1" + NUMBERS, "3: time_s is 1.0, must be greater than 1.0"),
    "no end": (
        HEADER + "0" + NUMBERS + "1,0,0,0,0,0,-0.",
        "3: the line does not end, so the log was cut off within it",
    ),
    "time runs back": (HEADER + "2" + NUMBERS + "1" + NUMBERS, "3: time_s is 1.0, must be greater than 2.0"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD.keys())
def test_a_log_that_does_not_fit_is_refused_with_file_and_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(RecorderError) as refused:
        read(path)
    assert str(refused.value) == f"{path}:{message}"


def test_what_a_spreadsheet_saves_can_be_read(tmp_path: Path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEADER + "0" + NUMBERS).replace("\n", "\r\n").encode())
    assert len(list(read(path).messages())) == 1
