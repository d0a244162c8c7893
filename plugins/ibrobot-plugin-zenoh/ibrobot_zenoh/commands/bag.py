"""`ibrobot bag play`: publishes a recorded episode at its times, without the topics that command a robot."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, suppress
from pathlib import Path

import attrs
from ibrobot_ros2.convert import make_class
from ibrobot_ros2.definitions import standard_types
from ibrobot_ros2.offers import CLOCK, CLOCK_TYPE
from ibrobot_terminal.plural import counted

from ibrobot_core.api import (
    NS_PER_S,
    Clock,
    Contract,
    EpisodeReader,
    EpisodeSummary,
    IbrobotError,
    Message,
    NotSupported,
    RealClock,
    Recorded,
    RecorderError,
    did_you_mean,
    ns,
    option,
)
from ibrobot_core.app import RequestError, echo, installed_plugins, wrong_input
from ibrobot_zenoh.commands.network import OnNetwork

_LATCHED = ("/tf_static", "/robot_description")
"""Topics whose last message is for later subscribers, too."""
_COMMAND_TYPES = ("trajectory_msgs/msg/JointTrajectory", "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
_COMMAND_NAME = re.compile(r"(?:^|[/_])(?:cmd|commands?|goal|target)(?:$|[/_])")


@attrs.frozen(kw_only=True)
class Play(OnNetwork):
    """Play EPISODE: publish its messages at their times, with their stamps.

    A run of ibrobot receives the topics of its `transport.share.subscribe`, and ROS 2 nodes receive all. Topics that
    command a robot are not played, so that no arm moves by it: the actions of the recorded contract, trajectories,
    twists, and names with cmd, command, goal or target. To look at one, give it another name with --remap.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    rate: float = option(1.0, typed="-r", ge=0.001, le=1000, help="speed")
    loop: bool = option(False, typed="-l", help="begin again at the end, until Ctrl-C")
    start_offset: float = option(0.0, ge=0, unit="s", help="begin so many seconds in")
    clock_hz: float | None = option(
        None, typed="--clock [HZ=40]", ge=0.001, le=1000,
        help="also publish the recorded time on /clock; 40 Hz without a number",
    )  # fmt: skip
    topics: tuple[str, ...] = option((), typed="--topics TOPIC", help="play only this topic; can be repeated")
    exclude_topics: tuple[str, ...] = option(
        (), typed="--exclude-topics TOPIC", help="leave out this topic; can be repeated"
    )
    renamed: tuple[str, ...] = option((), typed="-m --remap OLD:=NEW", help="play a topic under another name")

    def __call__(self) -> None:
        names = dict(_renaming(each) for each in self.renamed)
        with wrong_input():
            opened = installed_plugins().open_episode(self.episode)
        with closing(opened) as reader:
            summary = reader.summary()
            chosen = choose(summary, self.topics, self.exclude_topics, names)
            start_ns = summary.start_ns + ns(self.start_offset)
            if start_ns > summary.end_ns:
                length = (summary.end_ns - summary.start_ns) / NS_PER_S
                raise RecorderError(
                    f"{self.episode}: --start-offset {self.start_offset:g} is after its end; it lasts {length:.1f} s"
                )
            chosen = readable(reader, chosen, start_ns, self.topics)
            with suppress(KeyboardInterrupt), self.network() as transport:
                player = Player(RealClock(), transport.publish_message, chosen, self.rate, self.clock_hz)
                while True:
                    player.play(reader.messages_since(start_ns, list(chosen)), start_ns)
                    if not self.loop:
                        break
            echo(f"{counted(player.count, 'message')} on {counted(len(chosen), 'topic')}")


@attrs.define
class Player:
    """Publishes messages at their times.

    Args:
        clock: the time to play by.
        publish: publishes a message on a topic.
        names: topic in the episode -> topic to publish.
        rate: speed.
        clock_hz: how often to publish /clock [Hz]; None for never.
    """

    clock: Clock
    publish: Callable[..., object]
    names: Mapping[str, str]
    rate: float = 1.0
    clock_hz: float | None = None
    count: int = attrs.field(default=0, init=False)
    """Number of published messages."""
    _unsendable: set[str] = attrs.field(factory=set, init=False)

    def play(self, messages: Iterator[Recorded], start_ns: int) -> None:
        """Publish messages, the first of which may be at `start_ns` [ns]; returns after the last one."""
        began_ns, clock = self.clock.now_ns(), make_class(CLOCK_TYPE, standard_types())
        step_ns = None if self.clock_hz is None else max(1, round(NS_PER_S * self.rate / self.clock_hz))
        ticks = 0
        for each in messages:
            while step_ns is not None and start_ns + ticks * step_ns <= each.received_ns:
                self._wait(began_ns, ticks * step_ns)
                self.publish(CLOCK, clock(start_ns + ticks * step_ns))
                ticks += 1
            self._wait(began_ns, each.received_ns - start_ns)
            self._send(self.names[each.topic], each.message)

    def _wait(self, began_ns: int, recorded_ns: int) -> None:
        self.clock.sleep_until(began_ns + round(recorded_ns / self.rate))

    def _send(self, topic: str, message: Message) -> None:
        try:
            self.publish(topic, message, latched=topic in _LATCHED)
        except IbrobotError as error:
            if topic not in self._unsendable:
                self._unsendable.add(topic)
                echo(f"{topic} is not played: {error}", err=True)
            return
        self.count += 1


def commands(summary: EpisodeSummary) -> dict[str, str]:
    """The topics of an episode that command a robot -> why."""
    contract = Contract.of_episode(summary.metadata)
    actions = {part.topic for part in contract.action_parts} if contract is not None else set()
    reasons = {}
    for topic, about in summary.topics.items():
        if topic in actions:
            reasons[topic] = "an action of the recorded contract"
        elif about.type in _COMMAND_TYPES:
            reasons[topic] = f"a {about.type}"
        elif _COMMAND_NAME.search(topic):
            reasons[topic] = "by its name"
    return reasons


def choose(
    summary: EpisodeSummary, topics: Collection[str], excluded: Collection[str], names: Mapping[str, str]
) -> dict[str, str]:
    """Topic of an episode -> the name to play it under.

    Args:
        summary: the episode.
        topics: those to play; all if empty.
        excluded: those to leave out.
        names: topic -> another name.

    Raises:
        NotSupported: for a topic that is not there, or commands a robot.
    """
    known = list(summary.topics)
    for topic in (*topics, *excluded, *names):
        if topic not in known:
            raise NotSupported(f"{summary.path}: has no topic {topic!r}{did_you_mean(topic, known, 'its topics')}")
    forbidden = commands(summary)
    for topic, new in names.items():
        if not new.startswith("/"):
            raise NotSupported(f"--remap {topic}:={new}: a topic starts with /")
        if new in forbidden or _COMMAND_NAME.search(new):
            raise NotSupported(f"--remap {topic}:={new}: {new} commands a robot; choose another name")
    wanted = [topic for topic in topics or known if topic not in excluded]
    for topic in topics:
        if topic in forbidden and topic not in names:
            reason = f"{topic} commands a robot ({forbidden[topic]}), and is not played"
            raise NotSupported(f"{reason}; give it another name, e.g. --remap {topic}:=/recorded/joints")
    left_out = [topic for topic in wanted if topic in forbidden and topic not in names]
    if left_out:
        echo(f"not played, as they command a robot: {', '.join(left_out)}", err=True)
    return {topic: names.get(topic, topic) for topic in wanted if topic not in left_out}


def readable(reader: EpisodeReader, chosen: Mapping[str, str], start_ns: int, asked: Collection[str]) -> dict[str, str]:
    """The chosen topics that can be read; prints why the others cannot, e.g. since their messages are JSON.

    Args:
        reader: of the episode.
        chosen: topic -> the name to play it under.
        start_ns: from when it is played [ns].
        asked: the topics that the operator has named.

    Raises:
        RecorderError: for a topic that the operator has named, or if none can be read.
    """
    topics, errors = dict(chosen), []
    for topic in chosen:
        try:
            next(reader.messages_since(start_ns, [topic]), None)
        except RecorderError as error:
            if topic in asked:
                raise
            errors.append(error)
            del topics[topic]
    if errors and not topics:
        raise errors[0]
    for each in errors:
        echo(f"not played: {each}", err=True)
    return topics


def _renaming(text: str) -> tuple[str, str]:
    old, sign, new = text.partition(":=")
    if not sign or not old or not new:
        raise RequestError(f"--remap: expected OLD:=NEW, got {text!r}")
    return old, new
