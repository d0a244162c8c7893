"""Topics between the bus of a run and ROS: which, under which names, and with which quality of service."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping
from typing import Any

from ibrobot_ros2 import decode, encode
from ibrobot_ros2.interfaces import fields_of
from ibrobot_ros2.offers import CLOCK, CLOCK_TYPE

from ibrobot_core.api import MESSAGE_TYPES, NS_PER_S, IbrobotError, JointState
from ibrobot_core.app import Channel, Received, RunView, Subscription
from ibrobot_ros.options import NAME, Ros2ControlOptions, RosOptions

type Frame = tuple[dict[str, Any], bytes]
"""A message for the node, with the bytes of a message of ROS."""
_CLOCK_CDR = struct.Struct("<4siI")
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
GLOBAL = ("/tf", "/tf_static", CLOCK)
"""Topics that have the same name in every namespace."""
SENSOR_DATA = (
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu",
)  # fmt: skip
"""Types with ROS's profile for sensor data: best effort, so that a slow subscriber gets the newest."""
LATCHED = ("/tf_static", "/robot_description", "/robot_description_semantic")
"""Topics that ROS latches."""
LARGE = SENSOR_DATA[:3]
"""Types that are not sent to the node while nobody subscribes."""
DEPTH = 4096
"""Messages that wait for the thread that sends them, as many as for a recorder; what exceeds them is dropped."""
BACKLOG = 16 << 20
"""Bytes that the node may leave unread before messages for it are dropped."""


def profile(topic: str, type_name: str, qos: Mapping[str, str], *, latched: bool = False) -> str:
    """The QoS profile of a topic: that of the options, else that of ROS's tables."""
    if topic in qos:
        return qos[topic]
    if latched or topic in LATCHED:
        return "latched"
    return "sensor_data" if type_name in SENSOR_DATA else "default"


def ros_name(name: str, namespace: str) -> str:
    """The name of a topic or service in ROS."""
    prefix = namespace.strip("/")
    return name if name in GLOBAL or not prefix else f"/{prefix}{name}"


def _fields(type_name: str) -> list[str]:
    """The fields that a type has here; none for one that only a bag defines."""
    return fields_of(type_name) if type_name in MESSAGE_TYPES else []


class Topics:
    """Passes messages both ways, and counts what is lost.

    Attributes:
        counts: what happened -> how often, e.g. `dropped /image`.
    """

    def __init__(self, options: RosOptions, session: RunView) -> None:
        self._options = options
        self._session = session
        self.clock = session.config.simulated if options.clock is None else options.clock
        self.counts: Counter[str] = Counter()
        self._queue: Subscription | None = None
        self._declared: dict[str, str] = {}
        """Published topic -> its type."""
        self._subscribers: dict[str, int] = {}
        self._received = {ros_name(topic, options.namespace): topic for topic in options.subscribe}
        self._told: set[str] = set()
        hardware = [each.options for each in session.config.hardware.values()]
        self._theirs = {each.states for each in hardware if isinstance(each, Ros2ControlOptions)}
        """Topics of joint states that controllers in ROS publish already."""

    def open(self) -> None:
        """Subscribe to the bus, and state the types of what is received."""
        for topic, type_name in self._options.subscribe.items():
            self._session.bus.expect(topic, type_name)
        self._queue = self._session.bus.subscribe(None, DEPTH)

    def close(self) -> None:
        """Leave the bus."""
        queue, self._queue = self._queue, None
        if queue is not None:
            queue.close()

    def declare(self, channel: Channel) -> None:
        """Tell a new node which topics it has, with the newest message of those that are latched."""
        self._subscribers.clear()
        self._declared.clear()
        for topic, type_name in self._options.subscribe.items():
            qos = profile(topic, type_name, self._options.qos)
            name = ros_name(topic, self._options.namespace)
            head = {"op": "subscriber", "topic": name, "type": type_name, "fields": _fields(type_name), "qos": qos}
            channel.send({**head, "rate_hz": self._options.rate_hz})
        for received in self._session.bus.latched().values():
            channel.send_all(self._frames(received, channel.backlog))

    def send_next(self, channel: Channel, timeout_s: float) -> bool:
        """Send the messages of the bus that wait; returns whether there was one within `timeout_s` [s]."""
        queue = self._queue
        first = queue.get(timeout_s) if queue is not None else None
        if queue is None or first is None:
            return False
        if queue.lost:
            self._note_lost(queue)
        frames: list[Frame] = []
        for received in (first, *queue.drain()):
            frames += self._frames(received, channel.backlog)
            if self.clock and isinstance(received.message, JointState):
                frames += self._clock_frames(received.message.header.stamp_ns)
        channel.send_all(frames)
        return True

    def take(self, name: str, payload: memoryview) -> None:
        """Publish a message of ROS on the bus."""
        topic = self._received[name]
        try:
            self._session.bus.publish(topic, decode(self._options.subscribe[topic], payload))
        except IbrobotError as error:
            self.counts[f"refused {topic}"] += 1
            self.tell(f"a message from ROS was refused: {error}")

    def take_subscribers(self, name: str, count: int) -> None:
        """Note how many subscribers a topic has in ROS."""
        self._subscribers[name] = self.counts[f"subscribers {name}"] = count

    def tell(self, what: str) -> None:
        """Log a warning once."""
        if what not in self._told:
            self._told.add(what)
            self._session.log.warning("ros: %s", what)

    def _note_lost(self, queue: Subscription) -> None:
        """Count what the bus dropped because nobody took it in time."""
        for topic, lost in queue.lost.copy().items():
            self.counts[f"lost {topic}"] = lost
        self.tell("this machine is too slow for its topics: the oldest messages are dropped; ros.publish lists fewer")

    def _is_shared(self, topic: str) -> bool:
        if topic in self._options.subscribe or ros_name(topic, self._options.namespace) in self._theirs:
            return False
        return self._options.publish == "all" or topic in self._options.publish

    def _frames(self, received: Received, backlog: int) -> list[Frame]:
        """A message of the bus for a node that has not read `backlog` bytes [bytes] yet."""
        topic, type_name = received.topic, received.message.ros_type
        if not self._is_shared(topic):
            return []
        name = ros_name(topic, self._options.namespace)
        frames: list[Frame] = []
        if topic not in self._declared:
            self._declared[topic] = type_name
            if not NAME.fullmatch(name):
                self.tell(f"{topic} is no ROS 2 name, so that it is not published")
            else:
                latched = topic in self._session.bus.latched()
                qos = profile(topic, type_name, self._options.qos, latched=latched)
                head = {"op": "publisher", "topic": name, "type": type_name, "fields": _fields(type_name), "qos": qos}
                frames.append((head, b""))
        if type_name in LARGE and not self._subscribers.get(name):
            self.counts[f"sent {topic}"] += 0  # it is listed
            return frames
        if backlog > BACKLOG:
            self.counts[f"dropped {topic}"] += 1
            return frames
        try:
            frames.append(({"op": "message", "topic": name}, encode(received.message).tobytes()))
            self.counts[f"sent {topic}"] += 1
        except IbrobotError as error:
            self.counts[f"refused {topic}"] += 1
            self.tell(f"{topic}: {error}")
        return frames

    def _clock_frames(self, now_ns: int) -> list[Frame]:
        frames: list[Frame] = []
        if CLOCK not in self._declared:
            self._declared[CLOCK] = CLOCK_TYPE
            frames.append(({"op": "publisher", "topic": CLOCK, "type": CLOCK_TYPE, "qos": "sensor_data"}, b""))
        text = _CLOCK_CDR.pack(_LITTLE_ENDIAN, *divmod(now_ns, NS_PER_S))
        return [*frames, ({"op": "message", "topic": CLOCK}, text)]
