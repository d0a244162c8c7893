"""Makes `jazzy.json`: messages as a real ROS 2 Jazzy serialises them, and its type hashes.

Not a test. Run in an environment of its own, Python 3.12:

    pip install ros-jazzy-rclpy ros-jazzy-rmw-fastrtps-cpp ros-jazzy-std-msgs ros-jazzy-sensor-msgs \
        ros-jazzy-geometry-msgs ros-jazzy-trajectory-msgs ros-jazzy-diagnostic-msgs ros-jazzy-nav-msgs numpy
    python make_jazzy.py > jazzy.json

Every field has a value; sequences have 0, 1, 2 and 3 elements. What core's messages leave out is zero.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

TYPES = {
    "std_msgs": ("Bool", "Int8", "Int32", "String", "Float32MultiArray", "Float64MultiArray", "Int32MultiArray"),
    "sensor_msgs": (
        "JointState",
        "Image",
        "CompressedImage",
        "CameraInfo",
        "Imu",
        "Joy",
        "PointCloud2",
        "Range",
        "Temperature",
        "FluidPressure",
        "MagneticField",
        "BatteryState",
        "LaserScan",
        "NavSatStatus",
        "NavSatFix",
    ),
    "geometry_msgs": (
        "Pose",
        "PoseStamped",
        "Twist",
        "TwistStamped",
        "TransformStamped",
        "Wrench",
        "WrenchStamped",
        "PoseWithCovariance",
        "TwistWithCovariance",
    ),
    "nav_msgs": ("Odometry",),
    "trajectory_msgs": ("JointTrajectory",),
    "diagnostic_msgs": ("DiagnosticArray",),
}
LEFT_OUT = ("binning_x", "binning_y", "roi")
LETTERS = [97, 98, 233, 8364, 32]


def message_class(name):
    package, _, short = name.rpartition("/")
    return getattr(importlib.import_module(f"{package.split('/')[0]}.msg"), short)


def fill(cls, rng, length):
    message = cls()
    for name, kind in message.get_fields_and_field_types().items():
        if name not in LEFT_OUT:
            setattr(message, name, value(kind, rng, length))
    return message


def value(kind, rng, length):
    if kind.startswith("sequence<"):
        return [element(kind[9:-1], rng, length) for _ in range(length)]
    if kind.endswith("]"):
        kind, count = kind[:-1].split("[")
        return [element(kind, rng, length) for _ in range(int(count))]
    return element(kind, rng, length)


def element(kind, rng, length):
    if kind in ("float", "double"):
        return float(np.float32(rng.normal()))
    if kind == "boolean":
        return bool(rng.integers(2))
    if kind == "octet":
        return bytes([int(rng.integers(4))])
    if kind.startswith(("int", "uint")):
        return int(rng.integers(1, 100))
    if kind == "string":
        return "".join(map(chr, rng.choice(LETTERS, int(rng.integers(1, 9)))))
    return fill(message_class(kind), rng, length)


def type_hash(name):
    facts = json.loads((Path(sys.prefix) / "share" / f"{name}.json").read_text())
    return next(entry["hash_string"] for entry in facts["type_hashes"] if entry["type_name"] == name)


def main():
    made = {}
    for name in (f"{package}/msg/{short}" for package, names in TYPES.items() for short in names):
        rng = np.random.default_rng(0)
        messages = [fill(message_class(name), rng, length) for length in range(4)]
        made[name] = {"hash": type_hash(name), "cdr": [serialize_message(message).hex() for message in messages]}
    json.dump(made, sys.stdout, indent=1)


if __name__ == "__main__":
    main()
