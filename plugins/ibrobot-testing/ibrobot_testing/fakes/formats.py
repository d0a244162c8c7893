"""Fakes of formats: messages, compressed pictures, computed numbers, units of policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import CompressedImage, Contract, ContractError, Frame, Header, Image, Message
from ibrobot_core.app import JointFeature, ModelConfig, PolicyVectors, RobotConfig


@attrs.frozen
class FakeMessage(
    Message,
    ros_type="fake_msgs/msg/FakeMessage",
    whole=("value", "variance"),
    definition="std_msgs/Header header\nfloat64 value\nfloat64 variance\n",
):
    """A measured number, and how much it varies."""

    header: Header = Header()
    value: float = 0.0
    variance: float = 0.0


def decode_fake(picture: CompressedImage) -> Image | None:
    """Pixels of a picture in the format `fake`.

    It has height and width as two bytes each, little-endian, then a red, a green and a blue byte for each pixel.

    Raises:
        ContractError: if there are more or fewer bytes than height and width say.
    """
    if picture.format != "fake":
        return None
    data = picture.data.tobytes()
    height, width = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
    if len(data) != 4 + 3 * height * width or not height * width:
        raise ContractError(f"damaged picture: {len(data)} bytes for {height} rows of {width} pixels")
    pixels = np.frombuffer(data, np.uint8, offset=4)
    return Image(picture.header, height, width, "rgb8", 3 * width, pixels)


def fake_feature(model: Mapping[str, Any], paths: Sequence[str], joints: Sequence[str]) -> JointFeature:
    """The numbers `fake.sum` and `fake.spread`.

    They are the sum of all positions, and the largest less the smallest [rad].

    Args:
        model: has the names of the joints.
        paths: these of the numbers, in the order of the result.
        joints: the joints that move, if an action names the numbers.

    Raises:
        ContractError: for another path, or in an action.
    """
    known: dict[str, Callable[[NDArray[np.float64]], float]] = {"fake.sum": np.sum, "fake.spread": np.ptp}
    if joints:
        raise ContractError(f"{paths[0]!r}: no action can be computed from it")
    if unknown := [path for path in paths if path not in known]:
        raise ContractError(f"{unknown[0]!r} is not a number of joints; available: {', '.join(known)}")
    numbers = [known[path] for path in paths]

    def values(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([number(positions) for number in numbers])

    return JointFeature(tuple(model["joints"]), tuple(paths), values)


class FakeUnits(PolicyVectors):
    """Positions of joints in degrees, for models with `norm_mode: degrees`.

    Raises:
        ContractError: for another unit.
    """

    def __init__(self, robot: RobotConfig, model: ModelConfig, contract: Contract) -> None:
        if model.norm_mode != "degrees":
            raise ContractError(f"norm_mode is {model.norm_mode}, must be degrees")

    @override
    def __call__(self, values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        joints = ("action", "observation.state")
        return {key: np.degrees(value) if key in joints else value for key, value in values.items()}

    @override
    def frame(self, frame: Frame) -> Frame:
        prefix = None if frame.prefix is None else np.degrees(frame.prefix)
        history = tuple(self.frame(each) for each in frame.history)
        return attrs.evolve(frame, values=self(frame.values), prefix=prefix, history=history)

    @override
    def radians(self, key: str, value: NDArray[Any]) -> NDArray[Any]:
        return np.radians(value) if key in ("action", "observation.state") else value
