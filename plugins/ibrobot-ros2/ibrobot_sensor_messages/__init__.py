"""The plugin's hook: messages of sensors that core has no use for itself."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, MessageDescriptor, hookimpl

_TYPES = {
    "geometry_msgs": ("Wrench", "WrenchStamped", "PoseWithCovariance", "TwistWithCovariance"),
    "sensor_msgs": (
        "Range", "Temperature", "FluidPressure", "MagneticField", "BatteryState", "LaserScan", "NavSatStatus",
        "NavSatFix",
    ),
    "nav_msgs": ("Odometry",),
    "ibrobot_msgs": ("AudioBlock",),
}  # fmt: skip
"""Package of ROS -> names."""


@hookimpl
def ibrobot_messages() -> Iterable[MessageDescriptor]:
    """Force and torque, distance, temperature, pressure, battery, scan, odometry, satellite fix, audio."""
    for package, names in _TYPES.items():
        for name in names:
            yield MessageDescriptor(f"{package}/msg/{name}", Late(f"ibrobot_sensor_messages.messages:{name}"))
