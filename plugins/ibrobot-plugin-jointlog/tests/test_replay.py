"""Replay: the way to the log, the log by time, its end, and logs that cannot be played."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import override

import numpy as np
import pytest
from ibrobot_jointlog import ibrobot_teleop
from ibrobot_jointlog.log import header, row
from ibrobot_jointlog.options import ReplayOptions
from ibrobot_jointlog.replay import ReplayTeleop
from ibrobot_testing import TeleopSuite, host_context, make_robot

from ibrobot_core.errors import TeleopError
from ibrobot_core.interfaces import Context, JointReading, Teleop, TeleopCommand
from ibrobot_core.units import ns

ROBOT = make_robot()
JOINTS = ROBOT.joint_names
WAVE = [[0.1 * i, -0.2 * i, 0.3, 0.0, 0.01 * i, 0.5] for i in range(5)]
"""Positions at 0.0, 0.1, … 0.4 s after the first."""


def write_log(path: Path, positions: list[list[float]], joints: tuple[str, ...] = JOINTS, start: float = 2.0) -> Path:
    path.write_text(header(joints) + "".join(row(ns(start + 0.1 * i), p) for i, p in enumerate(positions)))
    return path


def reading(time_s: float, position: list[float]) -> JointReading:
    return JointReading(ns(1000 + time_s), np.array(position), np.zeros(6), np.zeros(6))


def replay(path: Path, at: list[float], **options: object) -> ReplayTeleop:
    """A replay that was activated at `at` and read once, at time 0."""
    teleop = ReplayTeleop(ReplayOptions(path, **options), host_context())
    teleop.connect()
    teleop.activate(reading(0, at))
    assert vector(teleop.read(reading(0, at))) == pytest.approx(at)
    return teleop


def vector(command: TeleopCommand) -> list[float]:
    assert command.positions is not None
    return [command.positions[joint] for joint in JOINTS]


class TestReplay(TeleopSuite):
    has_deadman = False

    @pytest.fixture(autouse=True)
    def _log(self, tmp_path_factory):
        self.path = write_log(tmp_path_factory.mktemp("log") / "joints.csv", WAVE)
        self.typed = queue.SimpleQueue[str]()

    @override
    def context(self) -> Context:
        return host_context(keys=lambda: self.typed)

    @override
    def make(self, ctx: Context) -> Teleop:
        return ReplayTeleop(ReplayOptions(self.path), ctx)

    @override
    def engage(self, teleop: Teleop) -> None:
        self.typed.put("space")

    @override
    def operate(self, teleop: Teleop) -> None:
        """The log itself asks for motion."""


def test_a_robot_at_the_first_sample_follows_the_log_by_time(tmp_path):
    teleop = replay(write_log(tmp_path / "log.csv", WAVE), WAVE[0])
    assert vector(teleop.read(reading(0.1, WAVE[0]))) == pytest.approx(WAVE[1])
    assert vector(teleop.read(reading(0.25, WAVE[0]))) == pytest.approx(np.add(WAVE[2], WAVE[3]) / 2)


def test_the_columns_may_stand_in_any_order(tmp_path):
    path = write_log(tmp_path / "log.csv", [p[::-1] for p in WAVE], joints=JOINTS[::-1])
    assert vector(replay(path, WAVE[0]).read(reading(0.2, WAVE[0]))) == pytest.approx(WAVE[2])


def test_speed_stretches_time(tmp_path):
    teleop = replay(write_log(tmp_path / "log.csv", WAVE), WAVE[0], speed=0.5)
    assert vector(teleop.read(reading(0.2, WAVE[0]))) == pytest.approx(WAVE[1])


def test_it_finishes_at_the_last_sample_and_stays_there(tmp_path):
    teleop = replay(write_log(tmp_path / "log.csv", WAVE), WAVE[0])
    assert not teleop.read(reading(0.39, WAVE[0])).finished
    for time in (0.4, 7.0):
        command = teleop.read(reading(time, WAVE[0]))
        assert command.finished
        assert vector(command) == WAVE[-1]


def test_without_a_terminal_it_plays_as_soon_as_its_mode_begins(tmp_path):
    teleop = ReplayTeleop(ReplayOptions(write_log(tmp_path / "log.csv", WAVE)), host_context())
    teleop.connect()
    teleop.activate(reading(0, WAVE[0]))
    assert vector(teleop.read(reading(0, WAVE[0]))) == WAVE[0]


def test_the_panel_says_what_to_press(tmp_path):
    typed = queue.SimpleQueue[str]()
    teleop = ReplayTeleop(ReplayOptions(write_log(tmp_path / "log.csv", WAVE)), host_context(keys=lambda: typed))
    teleop.connect()
    teleop.activate(reading(0, WAVE[0]))
    assert teleop.help().startswith("press space to replay")
    typed.put("space")
    teleop.read(reading(0, WAVE[0]))
    assert teleop.help().startswith("replays")


def test_a_loop_goes_back_to_the_first_sample_without_a_jump_and_never_finishes(tmp_path):
    teleop = replay(write_log(tmp_path / "log.csv", WAVE), WAVE[0], loop=True)
    commands = [teleop.read(reading(0.01 * i, WAVE[0])) for i in range(1000)]
    path = np.array([vector(c) for c in commands])
    assert not any(c.finished for c in commands)
    # The log's own speed is 2 rad/s; the way back is slower.
    assert np.abs(np.diff(path, axis=0)).max() <= 0.0200001
    ends = np.all(np.isclose(path, WAVE[-1], atol=1e-3), axis=1)
    assert np.count_nonzero(np.diff(ends.astype(int)) == 1) > 2


def test_the_way_to_the_first_sample_is_bounded_in_speed_and_acceleration(tmp_path):
    far = [1.5, -1.0, -1.0, 1.0, 2.0, 0.0]
    teleop = replay(write_log(tmp_path / "log.csv", [WAVE[0], WAVE[0]]), far, approach_speed=0.8)
    path = [np.array(far)]
    while not (command := teleop.read(reading(0.01 * len(path), far))).finished:
        path.append(np.array(vector(command)))
    speeds = np.diff(path, axis=0) / 0.01
    assert np.abs(speeds).max() == pytest.approx(0.8, rel=1e-3)
    assert np.all(np.abs(np.diff(speeds, axis=0, prepend=0.0)) / 0.01 <= ROBOT.max_acceleration)
    # Straight: every joint has gone the same share of its way.
    shares = (np.array(path) - far) / (np.array(WAVE[0]) - far + 1e-300)
    moving = np.array(WAVE[0]) != far
    np.testing.assert_allclose(shares[:, moving], np.repeat(shares[:, :1], moving.sum(), axis=1), atol=1e-9)


@pytest.mark.parametrize(("way", "peak_speed", "peak_acceleration"), [(3.7, 2.0, None), (0.5, None, 5.0)])
def test_the_joints_own_limits_bound_the_way_too(tmp_path, way, peak_speed, peak_acceleration):
    # The pan joint of the test robot may move at 2 rad/s and accelerate at 10 rad/s^2, of which half is used.
    first = [-1.9, *WAVE[0][1:]]
    far = [-1.9 + way, *WAVE[0][1:]]
    teleop = replay(write_log(tmp_path / "log.csv", [first]), far, approach_speed=50.0)
    path = [vector(teleop.read(reading(0.001 * i, far)))[0] for i in range(5000)]
    speeds = np.diff(path) / 0.001
    if peak_speed:
        assert np.abs(speeds).max() == pytest.approx(peak_speed, rel=1e-3)
    if peak_acceleration:
        assert np.abs(np.diff(speeds)).max() / 0.001 == pytest.approx(peak_acceleration, rel=0.01)
    assert path[-1] == -1.9


def test_every_activation_begins_anew_from_where_the_robot_is(tmp_path):
    teleop = replay(write_log(tmp_path / "log.csv", WAVE), WAVE[0])
    assert teleop.read(reading(5, WAVE[0])).finished
    elsewhere = [0.5] * 6
    teleop.activate(reading(6, elsewhere))
    command = teleop.read(reading(6.5, elsewhere))
    assert vector(command) == elsewhere
    assert not command.finished


NUMBERS = ",0,0,0,0,0,0\n"
HEADER = header(JOINTS)
BAD = {
    "empty": ("", "1: the header begins with '', must be time_s,JOINT,…"),
    "no time": ("t,a\n", "1: the header begins with 't', must be time_s,JOINT,…"),
    "unknown joint": (
        HEADER.replace("elbow_flex", "elbow"),
        "1: no joint 'elbow'; the joints are: shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper",
    ),
    "missing joint": (HEADER.replace(",elbow_flex", ""), "1: joint 'elbow_flex' is missing"),
    "joint twice": (
        HEADER.replace("elbow_flex", "gripper"), "1: joint 'gripper' has 2 columns, must have one"
    ),
    "no rows": (HEADER, "1: no row follows the header, there must be at least one"),
    "short row": (HEADER + "0" + NUMBERS + "1,0,0\n", "3: 3 values, must be 7 as in the header"),
    "blank row": (HEADER + "0" + NUMBERS + "\n" + "1" + NUMBERS, "3: 1 values, must be 7 as in the header"),
    "text": (HEADER + "0,0,x,0,0,0,0\n", "2: shoulder_lift is 'x', must be a number"),
    "not finite": (HEADER + "0" + NUMBERS + "1,0,0,0,0,nan,0\n", "3: wrist_roll is nan, must be finite"),
    "time not finite": (HEADER + "inf" + NUMBERS, "2: time_s is inf, must be finite"),
    "time stands": (HEADER + "1" + NUMBERS + "1" + NUMBERS, "3: time_s is 1.0, must be above 1.0 of the row before"),
    "time runs back": (HEADER + "2" + NUMBERS + "1" + NUMBERS, "3: time_s is 1.0, must be above 2.0 of the row before"),
}  # fmt: skip


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD.keys())
def test_a_log_that_does_not_fit_is_refused_with_file_and_line(tmp_path, text, message):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(TeleopError) as refused:
        ReplayTeleop(ReplayOptions(path), host_context()).connect()
    assert str(refused.value) == f"{path}:{message}"


def test_a_log_that_is_not_there_is_named(tmp_path):
    with pytest.raises(TeleopError, match=r"none\.csv: cannot be read: .*No such file"):
        ReplayTeleop(ReplayOptions(tmp_path / "none.csv"), host_context()).connect()


def test_what_a_spreadsheet_saves_can_be_played(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\xef\xbb\xbf" + (HEADER + "0" + NUMBERS).replace("\n", "\r\n").encode())
    assert replay(path, [0.0] * 6).read(reading(0, [0.0] * 6)).finished


def test_the_hook_offers_replay(tmp_path):
    (descriptor,) = ibrobot_teleop()
    teleop = descriptor.make(ReplayOptions(tmp_path / "log.csv"), host_context())
    assert isinstance(teleop, ReplayTeleop)
    assert "log.csv" in teleop.help()
