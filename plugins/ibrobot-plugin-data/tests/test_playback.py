"""What a replay plays of an episode: at each tick of control the newest command, as the robot was told it."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_data.playback import Playback, read_playback

from ibrobot_core.api import (
    ActionPart,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    Float64MultiArray,
    Header,
    JointState,
    Recorded,
    RecorderError,
    TopicSummary,
)

MS = 1_000_000
PERIOD_NS = 10 * MS
START_NS = 1_700_000_000 * 1_000_000_000
ARM, GRIPPER = "/arm/commands", "/gripper/commands"
FLOATS = Float64MultiArray.ros_type
CONTRACT = Contract(
    30.0,
    (),
    (ActionPart("arm", ARM, FLOATS, "hold", ("pan", "lift")), ActionPart("grip", GRIPPER, FLOATS, "hold", ("grip",))),
)


class Episode(EpisodeReader):
    """An episode in memory."""

    def __init__(self, items: list[Recorded], *, sampled: bool = False) -> None:
        self._items = sorted(items, key=lambda item: item.received_ns)
        self.sampled = sampled  # type: ignore[misc]

    def summary(self) -> EpisodeSummary:
        topics: dict[str, TopicSummary] = {}
        for item in self._items:
            count = topics[item.topic].count if item.topic in topics else 0
            topics[item.topic] = TopicSummary(item.message.ros_type, count + 1)
        return EpisodeSummary(Path("episode"), True, 0, 0, topics, {}, "success")

    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        return (item for item in self._items if topics is None or item.topic in topics)

    def digest(self) -> str:
        return ""

    def close(self) -> None:
        pass


def sent(topic: str, at_ms: float, *values: float) -> Recorded:
    stamp_ns = START_NS + round(at_ms * MS)
    return Recorded(topic, Float64MultiArray(np.array(values)), stamp_ns, stamp_ns)


def measured(at_ms: float, **positions: float) -> Recorded:
    stamp_ns = START_NS + round(at_ms * MS)
    state = JointState(Header(stamp_ns), tuple(positions), np.array(list(positions.values())))
    return Recorded("/joint_states", state, stamp_ns, stamp_ns)


def play(*items: Recorded, sampled: bool = False) -> Playback:
    return read_playback(Episode(list(items), sampled=sampled), CONTRACT, PERIOD_NS)


def column(playback: Playback, joint: str) -> np.ndarray[Any, Any]:
    """The commands of a joint at the ticks."""
    found: np.ndarray[Any, Any] = playback.commands.positions[:, playback.joints.index(joint)]
    return found


def dense(topic: str, begin_ms: int, end_ms: int, size: int) -> list[Recorded]:
    return [sent(topic, at, *[at / 1000 + i for i in range(size)]) for at in range(begin_ms, end_ms, 10)]


times = st.lists(st.integers(0, 3_000), min_size=1, max_size=30, unique=True).map(sorted)


@given(arm=times, gripper=times)
def test_at_every_tick_the_newest_command_is_played(arm: list[int], gripper: list[int]) -> None:
    """Of dense, sparse, late and early-ending commands alike."""
    gaps = {ARM: np.diff(arm), GRIPPER: np.diff(gripper)}
    if any(len(each) and np.median(each) <= 15 for each in gaps.values()):
        return  # at the rate of control, commands belong to the nearest tick
    items = [sent(ARM, at, at, -at) for at in arm] + [sent(GRIPPER, at, at) for at in gripper]
    playback = play(*items)
    first, last = min(*arm, *gripper), max(*arm, *gripper)
    for joint, stamps in (("pan", arm), ("grip", gripper)):
        wanted = []
        for k in range(len(playback.commands.times)):
            by_then = [at for at in stamps if at <= first + 10 * k]
            wanted.append(by_then[-1] if by_then else stamps[0])
        np.testing.assert_array_equal(column(playback, joint), wanted)
    assert (last - first) / 1000 <= playback.duration < (last - first) / 1000 + 0.01
    np.testing.assert_allclose(np.diff(playback.commands.times), 0.01)


def test_a_gripper_commanded_late_does_not_shorten_the_motion() -> None:
    playback = play(*dense(ARM, 0, 5000, 2), *dense(GRIPPER, 3000, 5000, 1))
    assert playback.duration == pytest.approx(4.99)
    np.testing.assert_allclose(column(playback, "pan"), np.arange(500) / 100)
    np.testing.assert_allclose(column(playback, "grip")[:300], 3.0, err_msg="the approach leads to its first command")
    np.testing.assert_allclose(column(playback, "grip")[300:], np.arange(300, 500) / 100)


def test_before_its_first_command_a_joint_has_its_recorded_position() -> None:
    states = [measured(at, pan=0.0, lift=0.0, grip=0.3) for at in range(0, 5000, 10)]
    playback = play(*states, *dense(ARM, 0, 5000, 2), *dense(GRIPPER, 3000, 5000, 1))
    np.testing.assert_allclose(column(playback, "grip")[:300], 0.3)


def test_commands_that_end_early_do_not_shorten_those_of_other_joints() -> None:
    playback = play(*dense(ARM, 0, 2000, 2), *dense(GRIPPER, 0, 5000, 1))
    assert playback.duration == pytest.approx(4.99)
    np.testing.assert_allclose(column(playback, "pan")[199:], 1.99)
    np.testing.assert_allclose(column(playback, "grip"), np.arange(500) / 100)


def test_between_two_commands_a_joint_holds() -> None:
    playback = play(*dense(ARM, 0, 5000, 2), sent(GRIPPER, 0, 0.1), sent(GRIPPER, 4000, 0.9))
    np.testing.assert_array_equal(column(playback, "grip"), [0.1] * 400 + [0.9] * 100)


def test_joints_without_any_command_are_left_out() -> None:
    playback = play(*dense(ARM, 0, 100, 2))
    assert playback.joints == ("pan", "lift")
    with pytest.raises(RecorderError, match="no message of /arm/commands, /gripper/commands, so nothing to replay"):
        play(measured(0, pan=0.0))


@given(jitter=st.lists(st.floats(-4.9, 4.9), min_size=30, max_size=30))
def test_commands_at_the_rate_of_control_are_played_one_a_tick(jitter: list[float]) -> None:
    """Receipt varies by less than half a period around that of the first, so none is skipped or doubled."""
    jitter[0] = 0.0
    items = [sent(ARM, 10 * k + late, k, 0) for k, late in enumerate(jitter)]
    playback = play(*items, sent(GRIPPER, 0, 0.0))
    np.testing.assert_array_equal(column(playback, "pan")[:30], np.arange(30))


def test_samples_of_a_motion_are_interpolated() -> None:
    """Rows of a dataset, at 30 Hz, are not steps."""
    playback = play(*[sent(ARM, k * 100 / 3, k / 3, 0) for k in range(10)], sent(GRIPPER, 0, 0.0), sampled=True)
    np.testing.assert_allclose(column(playback, "pan"), np.arange(31) / 10, atol=1e-6)


def test_a_command_that_is_not_finite_is_refused() -> None:
    with pytest.raises(RecorderError, match="its commands are not all finite"):
        play(sent(ARM, 0, np.nan, 0.0))
