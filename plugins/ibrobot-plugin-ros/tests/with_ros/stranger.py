"""A plain subscriber, as in a tutorial: `python stranger.py TOPIC COUNT` ends once so many pictures came."""

import sys

import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image


def main():
    topic, count = sys.argv[1], int(sys.argv[2])
    taken = []
    rclpy.init()
    node = rclpy.create_node("stranger")
    node.create_subscription(
        Image, topic, lambda message: taken.append((message.width, message.height)), qos_profile_sensor_data
    )
    print("ready", flush=True)
    while len(taken) < count:
        rclpy.spin_once(node)
    print(taken[-1], flush=True)


if __name__ == "__main__":
    main()
