"""A ROS 2 node of another make, on the router that is given: lists topics, and answers on /reply what it hears."""

from __future__ import annotations

import sys

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.discovery import get_topic_names_and_types

port = int(sys.argv[1])
DEFINITION = "string data\n"

publisher = ROS2Publisher("/reply", "std_msgs/msg/String", DEFINITION, domain_id=0, router_port=port)
subscriber = ROS2Subscriber(
    "/lab/chatter",
    "std_msgs/msg/String",
    lambda message: publisher.publish(data=f"heard {message.data}"),
    DEFINITION,
    domain_id=0,
    router_port=port,
)
topics: list[str] = []
while "/lab/chatter" not in topics or "/reply" not in topics:
    topics = [name for name, _ in get_topic_names_and_types(domain_id=0, router_port=port)]
print(*topics, flush=True)
sys.stdin.read()
