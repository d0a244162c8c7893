"""The node's process: opens ROS, says what it found, and does what the run asks until it ends."""

from __future__ import annotations

import importlib
import importlib.util
import os
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

from ibrobot_core.app import Channel, ChannelMessage

INTERFACES = ("std_srvs", "control_msgs", "tf2_msgs", "ibrobot_msgs")
"""Packages of message types that not every ROS has."""
OLD = ("humble", "iron")
"""Distributions that know ROS_LOCALHOST_ONLY only; later ones warn of it."""
_POLL_S = 0.2
_POOL = 64
"""Most actions and services that can wait for the run at a time."""


def run(descriptor: int) -> None:
    """Run the node over an inherited socket."""
    channel = Channel(socket.socket(fileno=descriptor))
    order = channel.next(None)
    if order is None:
        return
    try:
        rclpy = importlib.import_module("rclpy")
    except ImportError as error:
        channel.send({"op": "missing", "what": f"{type(error).__name__}: {error}", "python": sys.executable})
        channel.flush(1.0)
        return
    if order["niceness"]:
        os.nice(order["niceness"])
    # Threads that take messages must not delay those of stops by the interpreter's usual 5 ms.
    sys.setswitchinterval(0.001)
    if os.environ.get("ROS_DISTRO") in OLD and os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") == "LOCALHOST":
        os.environ["ROS_LOCALHOST_ONLY"] = "1"
    rclpy.init(args=["--ros-args", "--log-level", "error"])
    channel.send({"op": "hello", **_found(rclpy)})
    if not order["probe"]:
        serve(channel, order["name"])
    channel.flush(1.0)
    channel.close()
    rclpy.try_shutdown()
    # Executors leave threads behind that Python would wait for.
    os._exit(0)


def _found(rclpy: Any) -> dict[str, Any]:
    return {
        "python": sys.executable,
        "rclpy": str(rclpy.__file__),
        "distro": os.environ.get("ROS_DISTRO", ""),
        "rmw": rclpy.get_rmw_implementation_identifier(),
        "domain": os.environ.get("ROS_DOMAIN_ID", "0"),
        "range": os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", ""),
        "interfaces": [name for name in INTERFACES if importlib.util.find_spec(name) is not None],
    }


def serve(channel: Channel, name: str) -> None:
    """Do what the run asks until it closes the socket."""
    from rclpy.executors import MultiThreadedExecutor, SingleThreadedExecutor

    from ibrobot_ros.node.actions import Actions
    from ibrobot_ros.node.services import Services
    from ibrobot_ros.node.topics import Topics

    rclpy: Any = importlib.import_module("rclpy")
    threads: list[threading.Thread] = []

    def node(suffix: str, executor: Any) -> Any:
        made = rclpy.create_node(f"{name}{suffix}", start_parameter_services=False)
        executor.add_node(made)
        threads.append(threading.Thread(target=executor.spin, name=f"ros{suffix}", daemon=True))
        return made

    # Three executors: neither a flood of messages nor slow services keep an emergency stop waiting.
    calls = node("", MultiThreadedExecutor(_POOL))
    urgent = node("_stop", SingleThreadedExecutor())
    topics = Topics(node("_topics", SingleThreadedExecutor()), channel)
    actions, services = Actions(calls, channel), Services(calls, urgent, channel)
    does: dict[str, Callable[[ChannelMessage], None]] = {
        "publisher": topics.add_publisher,
        "message": topics.publish,
        "subscriber": topics.add_subscriber,
        "action": actions.add,
        "decided": actions.decide,
        "feedback": actions.give_feedback,
        "ended": actions.end,
        "service": services.add,
        "answer": services.answer,
        "ping": lambda head: channel.send({"op": "pong"}),
    }
    for thread in threads:
        thread.start()
    while not channel.closed:
        for head in channel.receive(_POLL_S):
            if head["op"] == "end":
                topics.finish()
                return
            does[head["op"]](head)
        topics.watch()
