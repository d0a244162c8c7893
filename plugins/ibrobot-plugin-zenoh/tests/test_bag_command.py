"""`ibrobot bag play`: what is played, when, and what is not, so that no robot moves by it."""

from __future__ import annotations

import json
import queue
from collections.abc import Collection, Iterator
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from click.testing import CliRunner
from ibrobot_ros2.codec import decode, encode
from ibrobot_ros2.offers import CLOCK
from ibrobot_testing.command import command_line
from ibrobot_zenoh.commands import network as network_module
from ibrobot_zenoh.commands.bag import Player, choose, commands
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import (
    ActionPart,
    Bool,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    Float64MultiArray,
    Header,
    IbrobotError,
    JointState,
    Message,
    NotSupported,
    ReaderDescriptor,
    Recorded,
    RecorderError,
    SteppedClock,
    TopicSummary,
    TransportError,
)
from ibrobot_core.app import Registry

from .pair import WAIT_S, free_endpoint, router

bag = command_line("bag")

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
TYPES = {
    "/joint_states": "sensor_msgs/msg/JointState",
    "/lamp": "std_msgs/msg/Bool",
    "/arm/out": "std_msgs/msg/Float64MultiArray",
    "/gripper_controller/commands": "std_msgs/msg/Float64MultiArray",
    "/servo/twist": "geometry_msgs/msg/TwistStamped",
    "/planned": "trajectory_msgs/msg/JointTrajectory",
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/recommended": "std_msgs/msg/Bool",
}
ACTION = ActionPart("arm", "/arm/out", Float64MultiArray.ros_type, "hold", ("pan",))
FORBIDDEN = {"/arm/out", "/gripper_controller/commands", "/servo/twist", "/planned", "/goal_pose"}


class Episode(EpisodeReader):
    """Every topic at 0, 10, 20 … ms: Bool messages, and states."""

    @override
    def summary(self) -> EpisodeSummary:
        topics = {topic: TopicSummary(type_, 5) for topic, type_ in TYPES.items()}
        metadata = {"contract": json.dumps(Contract(30.0, (), (ACTION,)).canonical())}
        return EpisodeSummary(Path("taught"), True, START_NS, START_NS + 40 * MS, topics, metadata)

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        for tick in range(5):
            for topic in TYPES:
                if topics is None or topic in topics:
                    stamp_ns = START_NS + tick * 10 * MS
                    yield Recorded(topic, self.message(topic, tick), stamp_ns, stamp_ns)

    def message(self, topic: str, tick: int) -> Message:
        if topic == "/joint_states":
            return JointState(Header(tick), ("pan",), np.array([float(tick)]))
        return Bool(tick % 2 == 0) if TYPES[topic] == Bool.ros_type else Float64MultiArray(np.array([float(tick)]))

    @override
    def digest(self) -> str:
        return ""

    @override
    def close(self) -> None:
        pass


@attrs.define
class PartlyUnreadable(Episode):
    """Topics that cannot be read are refused before the first message, as the readers here do."""

    topics: Collection[str]

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        for topic in topics or TYPES:
            if topic in self.topics:
                raise RecorderError(f"taught: {topic} cannot be read: its messages are serialised as 'json'")
        yield from super().messages(topics)


@attrs.define
class Heard:
    """What was published, and when."""

    clock: SteppedClock
    found: list[tuple[int, str, Message]] = attrs.field(factory=list)
    latched: list[str] = attrs.field(factory=list)
    refused: str = ""

    def __call__(self, topic: str, message: Message, *, latched: bool = False) -> None:
        if topic == self.refused:
            raise TransportError("too large")
        self.found.append((self.clock.now_ns(), topic, message))
        self.latched += [topic] * latched


def played(names: dict[str, str], **options: Any) -> Heard:
    heard = Heard(SteppedClock(7_000_000))
    player = Player(heard.clock, heard, names, **options)
    player.play(Episode().messages(list(names)), START_NS)
    assert player.count == sum(topic != CLOCK for _, topic, _ in heard.found)
    return heard


@pytest.mark.parametrize(("rate", "step_ms"), [(1.0, 10), (2.0, 5), (0.5, 20)])
def test_messages_come_at_their_times(rate: float, step_ms: int) -> None:
    heard = played({"/lamp": "/lamp"}, rate=rate)
    assert [each[0] for each in heard.found] == [(7 + tick * step_ms) * MS for tick in range(5)]
    assert [each[2] for each in heard.found] == [Bool(tick % 2 == 0) for tick in range(5)]


def test_clock_has_the_recorded_time() -> None:
    heard = played({"/lamp": "/lamp"}, rate=2.0, clock_hz=400.0)
    clocks = [(at, message) for at, topic, message in heard.found if topic == CLOCK]
    assert [at for at, _ in clocks] == [7 * MS + tick * MS * 5 // 2 for tick in range(9)]
    sent: list[Any] = [decode("rosgraph_msgs/msg/Clock", encode(message)) for _, message in clocks]
    assert [each.clock_ns for each in sent] == [START_NS + tick * 5 * MS for tick in range(9)]


def test_topics_get_other_names_and_keep_their_stamps() -> None:
    heard = played({"/arm/out": "/recorded/joints"})
    assert {topic for _, topic, _ in heard.found} == {"/recorded/joints"}


def test_static_transforms_are_for_later_subscribers_too() -> None:
    assert set(played({"/lamp": "/tf_static"}).latched) == {"/tf_static"}
    assert played({"/lamp": "/lamp"}).latched == []


def test_message_that_cannot_be_sent_is_reported_once(capsys: pytest.CaptureFixture[str]) -> None:
    heard = Heard(SteppedClock(), refused="/lamp")
    player = Player(heard.clock, heard, {"/lamp": "/lamp", "/joint_states": "/joint_states"})
    player.play(Episode().messages(["/lamp", "/joint_states"]), START_NS)
    assert player.count == 5
    assert capsys.readouterr().err == "/lamp is not played: too large\n"


def test_what_commands_a_robot_is_not_played(capsys: pytest.CaptureFixture[str]) -> None:
    summary = Episode().summary()
    assert Contract.of_episode(summary.metadata) is not None
    assert set(commands(summary)) == FORBIDDEN
    assert set(choose(summary, (), (), {})) == set(TYPES) - FORBIDDEN
    assert (
        capsys.readouterr().err
        == f"not played, as they command a robot: {', '.join(t for t in TYPES if t in FORBIDDEN)}\n"
    )
    assert choose(summary, ["/arm/out"], (), {"/arm/out": "/old"}) == {"/arm/out": "/old"}
    assert choose(summary, ["/lamp", "/joint_states"], ["/lamp"], {}) == {"/joint_states": "/joint_states"}


@pytest.mark.parametrize("topic", sorted(FORBIDDEN))
def test_command_is_refused_under_its_own_name_and_that_of_another(topic: str) -> None:
    summary = Episode().summary()
    with pytest.raises(NotSupported, match=f"{topic} commands a robot .*, and is not played; give it another name"):
        choose(summary, [topic], (), {})
    for renamed in (topic, "/lamp"):
        with pytest.raises(NotSupported, match=f"{topic} commands a robot; choose another name"):
            choose(summary, (), (), {renamed: topic})


@pytest.mark.parametrize(
    ("topics", "names", "reason"),
    [
        (["/lampp"], {}, "taught: has no topic '/lampp', did you mean '/lamp'?"),
        ([], {"/no": "/x"}, "taught: has no topic '/no'"),
        ([], {"/lamp": "light"}, "--remap /lamp:=light: a topic starts with /"),
        ([], {"/lamp": "/my_cmd"}, "/my_cmd commands a robot"),
    ],
)
def test_wrong_topics_are_named(topics: list[str], names: dict[str, str], reason: str) -> None:
    with pytest.raises(NotSupported) as error:
        choose(Episode().summary(), topics, (), names)
    assert reason in str(error.value)


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> tuple[ZenohTransport, str]:
    """A machine on the network, and its address; the episode is at `taught`."""
    from_options = network_module.options_from

    def options(*arguments: Any) -> ZenohOptions:
        return attrs.evolve(from_options(*arguments), shared_memory=False)

    monkeypatch.setattr(network_module, "options_from", options)
    monkeypatch.setattr(network_module, "_CONNECT_S", WAIT_S)
    registry = Registry(readers=[ReaderDescriptor("taught", "", lambda path: True, lambda address: Episode())])
    monkeypatch.setattr("ibrobot_zenoh.commands.bag.installed_plugins", lambda: registry)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taught").mkdir()
    address = free_endpoint()
    return router(address), address


def _put(arrived: queue.SimpleQueue[tuple[str, Message]], topic: str, message: Message) -> None:
    arrived.put((topic, message))


def test_episode_is_played_into_the_network_without_its_commands(network: tuple[ZenohTransport, str]) -> None:
    machine, address = network
    arrived: queue.SimpleQueue[tuple[str, Message]] = queue.SimpleQueue()
    for topic in (*FORBIDDEN, "/joint_states", CLOCK):
        machine.subscribe_messages(topic, partial(_put, arrived, topic))
    arguments = ["play", "taught", "--endpoint", address, "--clock", "-r", "1000", "--start-offset", "0.01"]
    result = CliRunner().invoke(bag, arguments, catch_exceptions=False)
    assert result.output.endswith("12 messages on 3 topics\n")
    found: dict[str, list[Any]] = {}
    while sum(map(len, found.values())) < 5:
        topic, message = arrived.get(timeout=WAIT_S)
        found.setdefault(topic, []).append(message)
    assert [float(each.position[0]) for each in found.pop("/joint_states")] == [1.0, 2.0, 3.0, 4.0]
    assert set(found) == {CLOCK}
    assert arrived.empty()


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--start-offset", "9"], "taught: --start-offset 9 is after its end; it lasts 0.0 s"),
        (["--remap", "/lamp"], "expected OLD:=NEW, got '/lamp'"),
        (["--rate", "0"], "0.0 is too small, must be at least 0.001"),
        (["--topics", "/x"], "has no topic '/x'"),
    ],
)
def test_wrong_options_are_named(arguments: list[str], reason: str, network: tuple[ZenohTransport, str]) -> None:
    result = CliRunner().invoke(bag, ["play", "taught", "--endpoint", network[1], *arguments])
    assert result.exit_code != 0
    assert reason in (str(result.exception) if isinstance(result.exception, IbrobotError) else result.output)


PLAYED = ("/joint_states", "/lamp", "/recommended")
SUBSETS = [frozenset(each) for size in range(4) for each in combinations(PLAYED, size)]


@pytest.mark.parametrize("unreadable", SUBSETS, ids=lambda each: " ".join(sorted(each)) or "none")
@pytest.mark.parametrize("asked", SUBSETS, ids=lambda each: " ".join(sorted(each)) or "all")
def test_topics_that_cannot_be_read_are_named_and_leave_the_others(
    network: tuple[ZenohTransport, str], monkeypatch: pytest.MonkeyPatch, asked: frozenset[str],
    unreadable: frozenset[str],
) -> None:  # fmt: skip
    reader = ReaderDescriptor("taught", "", lambda path: True, lambda address: PartlyUnreadable(unreadable))
    monkeypatch.setattr("ibrobot_zenoh.commands.bag.installed_plugins", lambda: Registry(readers=[reader]))
    sent: list[str] = []
    monkeypatch.setattr(ZenohTransport, "publish_message", lambda self, topic, message, **options: sent.append(topic))
    chosen = [argument for topic in sorted(asked) for argument in ("--topics", topic)]
    result = CliRunner().invoke(bag, ["play", "taught", "--endpoint", network[1], "-r", "1000", *chosen])
    if asked & unreadable or (unreadable == frozenset(PLAYED) and not asked):
        assert isinstance(result.exception, RecorderError)
        assert str(result.exception).removesuffix("its messages are serialised as 'json'") in {
            f"taught: {topic} cannot be read: " for topic in (asked & unreadable or unreadable)
        }
        assert sent == []
        return
    assert result.exit_code == 0, result.exception
    lines = [line for line in result.output.splitlines() if line.startswith("not played: ")]
    assert lines == [
        f"not played: taught: {topic} cannot be read: its messages are serialised as 'json'"
        for topic in PLAYED
        if topic in unreadable and not asked
    ]
    assert set(sent) == (asked or frozenset(PLAYED) - unreadable)
