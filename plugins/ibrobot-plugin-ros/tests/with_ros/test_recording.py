"""What rclpy records of a run over the wire is what the run's own bag has."""

from __future__ import annotations

from contextlib import closing

from ibrobot_ros2 import encode

from ibrobot_core.app import installed_plugins

from .conftest import until

TOPICS = {"/joint_states": "sensor_msgs/msg/JointState", "/arm/commands": "std_msgs/msg/Float64MultiArray"}


def test_messages_on_the_wire_are_those_of_the_bag(start, peer, tmp_path):
    run = start("recording={type: mcap, topics: all}", mode="teleop", by_operator=True)
    for topic, type_name in TOPICS.items():
        peer.ask("subscribe", topic=topic, type=type_name)
        assert peer.ask("take", topic=topic, count=5)
    run.session.bus.call("/record_episode/start")
    before = len(run.commands)
    until(lambda: len(run.commands) > before + 300)
    run.session.bus.call("/record_episode/stop", "success")
    run.runtime.stop()
    folder = tmp_path / "episodes/default/episodes/episode_000001"
    bag: dict[str, list[str]] = {topic: [] for topic in TOPICS}
    with closing(installed_plugins().open_episode(folder)) as episode:
        for recorded in episode.messages(tuple(TOPICS)):
            bag[recorded.topic].append(encode(recorded.message).hex())
    for topic, messages in bag.items():
        # The wire began before the episode and ended after it.
        wire = [raw for _, raw in peer.ask("take", topic=topic, count=len(messages))]
        assert len(messages) > 100
        begin = next(i for i, raw in enumerate(wire) if raw.startswith(messages[0]))
        found = [raw[: len(message)] for raw, message in zip(wire[begin:], messages, strict=False)]
        assert found == messages
