"""A robot whose controller is a node of somebody else's: `python controller.py JOINT…`.

It takes positions on /arm_controller/commands, follows them with a lag, and publishes /joint_states 200 times a second.
"""

import json
import sys
import threading
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

LAG_S = 0.03
PERIOD_S = 0.005


class Controller:
    def __init__(self, joints):
        self.node = rclpy.create_node("controller")
        self.joints = joints
        self.position = [0.0] * (len(joints) - 1) + [0.8]
        self.command = list(self.position)
        self.trouble = ""
        self.publisher = self.node.create_publisher(JointState, "/joint_states", 10)
        self.node.create_subscription(Float64MultiArray, "/arm_controller/commands", self.take, 10)
        self.node.create_timer(PERIOD_S, self.tick)
        self.last = time.monotonic()

    def take(self, message):
        self.command = list(message.data)

    def tick(self):
        now = time.monotonic()
        share, self.last = min(1.0, (now - self.last) / LAG_S), now
        before = self.position
        self.position = [p + share * (c - p) for p, c in zip(before, self.command, strict=True)]
        if self.trouble == "silent":
            return
        state = JointState(name=self.joints[::-1], position=self.position[::-1])
        state.velocity = [(p - b) / PERIOD_S for p, b in zip(self.position, before, strict=True)][::-1]
        if self.trouble == "nan":
            state.position[0] = float("nan")
        state.header.stamp = self.node.get_clock().now().to_msg()
        if self.trouble == "other clock":
            state.header.stamp.sec = 17
        self.publisher.publish(state)

    def set(self, trouble):
        self.trouble = trouble

    def state(self):
        return {"position": self.position, "command": self.command}


def main():
    rclpy.init()
    controller = Controller(sys.argv[1:])
    executor = SingleThreadedExecutor()
    executor.add_node(controller.node)
    threading.Thread(target=executor.spin, daemon=True).start()
    print(json.dumps(["ready", None]), flush=True)
    for line in sys.stdin:
        method, keywords = json.loads(line)
        print(json.dumps(["done", getattr(controller, method)(**keywords)]), flush=True)


if __name__ == "__main__":
    main()
