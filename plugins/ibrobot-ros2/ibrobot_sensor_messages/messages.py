"""Messages of sensors that core has no use for itself: ROS 2's own types, field by field, and a stamped block of audio.

Fields, units and meanings are those of the `.msg` files of `geometry_msgs`, `nav_msgs` and `sensor_msgs`.
"""

from __future__ import annotations

from typing import Any

import attrs
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ibrobot_core.api import Header, Message, Pose, Twist, Vector3


def _array(dtype: type[np.generic], size: int = 0) -> Any:
    """A field for an array of numbers; zeros by default, `size` of them."""

    def convert(value: ArrayLike) -> NDArray[Any]:
        return np.asarray(value, dtype=dtype)

    return attrs.field(factory=lambda: np.zeros(size, dtype), converter=convert, eq=attrs.cmp_using(eq=np.array_equal))


@attrs.frozen
class Wrench(Message, ros_type="geometry_msgs/msg/Wrench", whole=("force", "torque")):
    """A force [N] and a torque [Nm]."""

    force: Vector3 = Vector3()
    torque: Vector3 = Vector3()


@attrs.frozen
class WrenchStamped(Message, ros_type="geometry_msgs/msg/WrenchStamped", whole=("wrench",)):
    """What a force-torque sensor measures, in the frame of the header."""

    header: Header = Header()
    wrench: Wrench = Wrench()


@attrs.frozen
class Range(Message, ros_type="sensor_msgs/msg/Range", whole=("range",)):
    """A distance, as from an ultrasonic or infrared sensor."""

    header: Header = Header()
    radiation_type: int = 0
    """0: ultrasound, 1: infrared."""
    field_of_view: float = 0.0
    """[rad]"""
    min_range: float = 0.0
    """[m]"""
    max_range: float = 0.0
    """[m]"""
    range: float = 0.0
    """[m]; -inf below `min_range`, inf above `max_range`."""
    variance: float = 0.0
    """[m^2]; 0 if it is unknown."""


@attrs.frozen
class Temperature(Message, ros_type="sensor_msgs/msg/Temperature", whole=("temperature",)):
    """A temperature."""

    header: Header = Header()
    temperature: float = 0.0
    """[deg C]"""
    variance: float = 0.0
    """0 if it is unknown."""


@attrs.frozen
class FluidPressure(Message, ros_type="sensor_msgs/msg/FluidPressure", whole=("fluid_pressure",)):
    """An absolute pressure, e.g. of a suction gripper."""

    header: Header = Header()
    fluid_pressure: float = 0.0
    """[Pa]"""
    variance: float = 0.0
    """0 if it is unknown."""


@attrs.frozen
class MagneticField(Message, ros_type="sensor_msgs/msg/MagneticField", whole=("magnetic_field",)):
    """A magnetic field."""

    header: Header = Header()
    magnetic_field: Vector3 = Vector3()
    """[T]"""
    magnetic_field_covariance: NDArray[np.float64] = _array(np.float64, 9)


@attrs.frozen
class BatteryState(Message, ros_type="sensor_msgs/msg/BatteryState", whole=("voltage", "current", "percentage")):
    """A battery; NaN for what it does not measure."""

    header: Header = Header()
    voltage: float = np.nan
    """[V]"""
    temperature: float = np.nan
    """[deg C]"""
    current: float = np.nan
    """[A], negative while it discharges."""
    charge: float = np.nan
    """[Ah]"""
    capacity: float = np.nan
    """[Ah]"""
    design_capacity: float = np.nan
    """[Ah]"""
    percentage: float = np.nan
    """0 to 1"""
    power_supply_status: int = 0
    power_supply_health: int = 0
    power_supply_technology: int = 0
    present: bool = True
    cell_voltage: NDArray[np.float32] = _array(np.float32)
    """[V]"""
    cell_temperature: NDArray[np.float32] = _array(np.float32)
    """[deg C]"""
    location: str = ""
    serial_number: str = ""


@attrs.frozen
class LaserScan(Message, ros_type="sensor_msgs/msg/LaserScan", whole=("ranges",)):
    """Distances of a planar scan, counter-clockwise about z, from `angle_min`."""

    header: Header = Header()
    angle_min: float = 0.0
    """[rad]"""
    angle_max: float = 0.0
    """[rad]"""
    angle_increment: float = 0.0
    """[rad]"""
    time_increment: float = 0.0
    """[s]"""
    scan_time: float = 0.0
    """[s]"""
    range_min: float = 0.0
    """[m]"""
    range_max: float = 0.0
    """[m]"""
    ranges: NDArray[np.float32] = _array(np.float32)
    """[m]"""
    intensities: NDArray[np.float32] = _array(np.float32)


@attrs.frozen
class PoseWithCovariance(Message, ros_type="geometry_msgs/msg/PoseWithCovariance", whole=("pose",)):
    """A pose, and the covariance of x, y, z and of the rotations about them, row by row."""

    pose: Pose = Pose()
    covariance: NDArray[np.float64] = _array(np.float64, 36)


@attrs.frozen
class TwistWithCovariance(Message, ros_type="geometry_msgs/msg/TwistWithCovariance", whole=("twist",)):
    """A twist and its covariance, as in `PoseWithCovariance`."""

    twist: Twist = Twist()
    covariance: NDArray[np.float64] = _array(np.float64, 36)


@attrs.frozen
class Odometry(Message, ros_type="nav_msgs/msg/Odometry", whole=("pose.pose", "twist.twist")):
    """Where a base is, in the frame of the header, and how it moves, in `child_frame_id`."""

    header: Header = Header()
    child_frame_id: str = ""
    pose: PoseWithCovariance = PoseWithCovariance()
    twist: TwistWithCovariance = TwistWithCovariance()


@attrs.frozen
class NavSatStatus(Message, ros_type="sensor_msgs/msg/NavSatStatus", whole=("status",)):
    """Whether a receiver has a fix, and of which satellites."""

    status: int = -2
    """-2: unknown, -1: no fix, 0: fix, 1: with satellite augmentation, 2: with ground stations."""
    service: int = 0


@attrs.frozen
class NavSatFix(Message, ros_type="sensor_msgs/msg/NavSatFix", whole=("latitude", "longitude", "altitude")):
    """A position on the WGS 84 ellipsoid."""

    header: Header = Header()
    status: NavSatStatus = NavSatStatus()
    latitude: float = 0.0
    """[deg]"""
    longitude: float = 0.0
    """[deg]"""
    altitude: float = 0.0
    """[m]"""
    position_covariance: NDArray[np.float64] = _array(np.float64, 9)
    """[m^2], east, north, up."""
    position_covariance_type: int = 0


@attrs.frozen
class AudioBlock(
    Message,
    ros_type="ibrobot_msgs/msg/AudioBlock",
    definition="std_msgs/Header header\nuint32 rate\nuint16 channels\nint16[] samples\n",
):
    """Samples of a microphone, interleaved; the stamp is that of the first."""

    header: Header = Header()
    rate: int = 16_000
    """[Hz], of each channel"""
    channels: int = 1
    samples: NDArray[np.int16] = _array(np.int16)


SENSOR_MESSAGES = (
    Wrench, WrenchStamped, Range, Temperature, FluidPressure, MagneticField, BatteryState, LaserScan,
    PoseWithCovariance, TwistWithCovariance, Odometry, NavSatStatus, NavSatFix, AudioBlock,
)  # fmt: skip
"""All classes here."""
