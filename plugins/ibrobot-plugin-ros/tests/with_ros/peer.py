"""A node of somebody else, written with rclpy alone: `python peer.py` does what JSON lines on its input say.

A line is `[method, keywords]`; the answer is a line with its result. It imports nothing of ibrobot.
"""

import importlib
import json
import sys
import threading
import time
from typing import Any

import rclpy
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message

NS = 1_000_000_000
PATIENCE_S = 20.0


def find(name):
    package, kind, base = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), base)


def profile(name):
    reliable = ReliabilityPolicy.BEST_EFFORT if name == "sensor_data" else ReliabilityPolicy.RELIABLE
    latched = DurabilityPolicy.TRANSIENT_LOCAL if name == "latched" else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=1000, reliability=reliable, durability=latched)


def fill(message, values):
    for name, value in values.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)


def until(ready, timeout_s=PATIENCE_S):
    deadline = time.monotonic() + timeout_s
    while not ready():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def done(future, timeout_s=PATIENCE_S):
    if not until(future.done, timeout_s):
        raise TimeoutError("no answer")
    return future.result()


class Peer:
    def __init__(self):
        self.node = rclpy.create_node("peer")
        self.received, self.publishers, self.clients, self.actions, self.handles = {}, {}, {}, {}, []

    def topics(self):
        return dict(self.node.get_topic_names_and_types())

    def await_topic(self, topic):
        return until(lambda: bool(self.node.get_publishers_info_by_topic(topic)))

    def await_subscriber(self, topic):
        return until(lambda: bool(self.node.get_subscriptions_info_by_topic(topic)))

    def subscribe(self, topic, type, qos="default", head=None):
        """Keep the messages of a topic, or their first bytes, with the time at which they came."""
        got = self.received[topic] = []
        keep = lambda raw: got.append((time.time_ns(), raw[:head]))  # noqa: E731
        self.node.create_subscription(find(type), topic, keep, profile(qos), raw=True)

    def publish_images(self, topic, count, rate_hz=30.0):
        """Publish images of 640x480 pixels with their stamps."""
        message = find("sensor_msgs/msg/Image")(height=480, width=640, encoding="rgb8", step=1920)
        message.data = bytes(640 * 480 * 3)
        publisher = self.node.create_publisher(type(message), topic, profile("sensor_data"))
        begun = time.monotonic()
        for i in range(count):
            time.sleep(max(0.0, begun + i / rate_hz - time.monotonic()))
            message.header.stamp = self.node.get_clock().now().to_msg()
            publisher.publish(message)

    def take(self, topic, count=1, timeout_s=PATIENCE_S):
        """The messages so far, re-serialised by ROS, once there are `count`."""
        until(lambda: len(self.received[topic]) >= count, timeout_s)
        return [(at, bytes(raw).hex()) for at, raw in list(self.received[topic])]

    def canonical(self, type, raw):
        """What ROS makes of bytes: those of the message that it reads in them."""
        return serialize_message(deserialize_message(bytes.fromhex(raw), find(type))).hex()

    def text(self, type, raw):
        """What ROS reads in bytes, as text, in which NaN is equal to NaN."""
        return repr(deserialize_message(bytes.fromhex(raw), find(type)))

    def publish(self, topic, type, raw, qos="default", count=1, rate_hz=0.0):
        publisher = self.publishers.get(topic)
        if publisher is None:
            publisher = self.publishers[topic] = self.node.create_publisher(find(type), topic, profile(qos))
            if qos != "latched":
                until(lambda: publisher.get_subscription_count() > 0)
        payload = bytes.fromhex(raw)
        begun = time.monotonic()
        for i in range(count):
            publisher.publish(payload)
            if rate_hz:
                time.sleep(max(0.0, begun + (i + 1) / rate_hz - time.monotonic()))
        return count

    def services(self):
        return dict(self.node.get_service_names_and_types())

    def call(self, name, type, request=None, count=1):
        cls = find(type)
        client = self.clients.get(name)
        if client is None:
            group = ReentrantCallbackGroup()
            client = self.clients[name] = self.node.create_client(cls, name, callback_group=group)
        if not client.wait_for_service(PATIENCE_S):
            return None
        answers = []
        for _ in range(count):
            sent = cls.Request()
            fill(sent, request or {})
            answer = done(client.call_async(sent))
            answers.append([answer.success, answer.message])
        return answers

    def _client(self, name, type):
        if name not in self.actions:
            self.actions[name] = ActionClient(self.node, find(type), name, callback_group=ReentrantCallbackGroup())
        if not self.actions[name].wait_for_server(PATIENCE_S):
            raise TimeoutError(f"no server of {name}")
        return self.actions[name]

    def follow(self, action, joints, points, path_tolerance=(), goal_tolerance=(), goal_time=0.0, after_s=None,
               then="", stamp_ns=0):  # fmt: skip
        """Send a trajectory: points are [time, positions, velocities].

        After `after_s` [s], `then`: `cancel` it, or return so that the next goal replaces it.
        """
        from control_msgs.msg import JointTolerance
        from trajectory_msgs.msg import JointTrajectoryPoint

        kind = find("control_msgs/action/FollowJointTrajectory")
        goal = kind.Goal()
        goal.trajectory.joint_names = joints
        goal.trajectory.header.stamp.sec, goal.trajectory.header.stamp.nanosec = divmod(stamp_ns, NS)
        for at, positions, velocities in points:
            point = JointTrajectoryPoint(positions=positions, velocities=velocities)
            point.time_from_start.sec, point.time_from_start.nanosec = divmod(round(at * NS), NS)
            goal.trajectory.points.append(point)
        goal.path_tolerance = [JointTolerance(name=n, position=p) for n, p in path_tolerance]
        goal.goal_tolerance = [JointTolerance(name=n, position=p) for n, p in goal_tolerance]
        leeway = goal.goal_time_tolerance
        leeway.sec, leeway.nanosec = divmod(round(goal_time * NS), NS)
        return self._send(action, "control_msgs/action/FollowJointTrajectory", goal, after_s, then)

    def grip(self, action, position, max_effort=0.0, after_s=None, then=""):
        goal = find("control_msgs/action/GripperCommand").Goal()
        goal.command.position, goal.command.max_effort = position, max_effort
        return self._send(action, "control_msgs/action/GripperCommand", goal, after_s, then)

    def grip_parallel(self, action, name, position):
        goal = find("control_msgs/action/ParallelGripperCommand").Goal()
        goal.command.name, goal.command.position = name, position
        return self._send(action, "control_msgs/action/ParallelGripperCommand", goal, None, "")

    def send(self, action, type, request, after_s=None, then=""):
        """Send a goal of any action, whose fields `request` has."""
        goal = find(type).Goal()
        fill(goal, request)
        return self._send(action, type, goal, after_s, then)

    def _send(self, action, type, goal, after_s, then):
        feedback: list[Any] = []
        handle = done(self._client(action, type).send_goal_async(goal, feedback_callback=feedback.append))
        if not handle.accepted:
            return {"accepted": False}
        result = handle.get_result_async()
        if after_s is not None:
            time.sleep(after_s)
            if then == "cancel":
                done(handle.cancel_goal_async())
            else:
                self.handles.append((result, feedback))
                return {"accepted": True}
        return self._outcome(result, feedback)

    def _outcome(self, result, feedback):
        answer = done(result, 60.0)
        names = {getattr(GoalStatus, f"STATUS_{name}"): name for name in ("SUCCEEDED", "CANCELED", "ABORTED")}
        found: dict[str, Any] = {"accepted": True, "status": names.get(answer.status), "feedback": len(feedback)}
        for field in answer.result.get_fields_and_field_types():
            value = getattr(answer.result, field)
            if isinstance(value, int | float | str):
                found[field] = value
            elif field == "action_chunk":
                found[field] = [
                    [
                        each.key,
                        each.type,
                        [d.size for d in each.float_64_array.layout.dim],
                        len(each.float_64_array.data),
                    ]
                    for each in value.variants
                ]
            elif field == "state":
                found[field] = [list(value.name), list(value.position)]
        return found

    def outcomes(self):
        """Those of goals that were left to be replaced."""
        found, self.handles = self.handles, []
        return [self._outcome(*each) for each in found]


def main():
    rclpy.init()
    peer = Peer()
    executor = MultiThreadedExecutor(8)
    executor.add_node(peer.node)
    threading.Thread(target=executor.spin, daemon=True).start()
    print(json.dumps(["ready", None]), flush=True)
    for line in sys.stdin:
        method, keywords = json.loads(line)
        try:
            answer = ["done", getattr(peer, method)(**keywords)]
        except Exception as error:  # noqa: BLE001 - the test shows it
            answer = ["failed", f"{type(error).__name__}: {error}"]
        print(json.dumps(answer), flush=True)
    import os

    os._exit(0)


if __name__ == "__main__":
    main()
