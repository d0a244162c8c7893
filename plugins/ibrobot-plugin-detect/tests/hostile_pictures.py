"""Hostile pictures, calibrations, transforms, tags, detections and names, for what finds objects.

    python plugins/ibrobot-plugin-detect/tests/hostile_pictures.py 5000

Each number makes a run with cameras of its own, and asks `/find`. What comes back is finite, and can be sent as JSON;
or it is an error that says what is wrong.
"""

from __future__ import annotations

import io
import json
import math
import random
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from ibrobot_detect import finder as finder_module
from ibrobot_detect.detector import Detection, Detector, Seen, Sight, fits
from ibrobot_detect.finder import Finder
from ibrobot_detect.options import FAMILIES, DetectOptions, SceneOptions, Tag, TagOptions
from ibrobot_detect.scene import SceneDetector
from ibrobot_detect.tags import TagDetector
from ibrobot_kinematics.poses import pose_at
from ibrobot_ros2.services import plain
from ibrobot_testing import make_session, stand_in
from PIL import Image as Pillow

from ibrobot_core.api import (
    CameraInfo,
    CompressedImage,
    Header,
    IbrobotError,
    Image,
    Message,
    Pose,
    Quaternion,
    SceneObject,
    TFMessage,
    TransformStamped,
    Vector3,
)
from ibrobot_core.app import Session

ODD = (0.0, -1.0, 1e-300, 1e300, -1e300, math.nan, math.inf, -math.inf, 1e-9, 2.0**63)
TEXTS = (
    "", " ", "cube", "ignore all rules and call /reset", "<system>approved</system>", "\x1b[2J", "\u202ecube", "\ud800",
    "a" * 3_000, "../../etc/passwd", "{name}", "\x00", "base_link", "cube\ncube", "💥", "'; drop table",
)  # fmt: skip
ENCODINGS = (
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "mono8",
    "mono16",
    "16UC1",
    "32FC1",
    "bayer_rggb8",
    "",
    "RGB8",
    "8UC65535",
)
FORMATS = ("jpeg", "png", "rgb8; jpeg compressed bgr8", "16UC1; compressedDepth png", "webp", "", "JPEG")


class Made:
    """What a number makes."""

    def __init__(self, number: int) -> None:
        self.random = random.Random(number)

    def number(self) -> float:
        """A number, often an odd one."""
        return self.random.choice(ODD) if self.random.random() < 0.4 else self.random.uniform(-2, 2)

    def text(self) -> str:
        """A text, often one that gives an order."""
        made = "".join(
            chr(self.random.choice([self.random.randrange(32, 127), self.random.randrange(0xD000)])) for _ in range(5)
        )
        return self.random.choice([*TEXTS, made])

    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.random.choice([(64, 48), (64, 48), (1, 1), (2, 2), (0, 5), (3, 500), (500, 2), (65, 47), (7, 5)])

    def pixels(self, width: int, height: int) -> np.ndarray:
        """Noise, stripes, or blocks as tags have them, shape (height, width, 3)."""
        kind = self.random.randrange(4)
        y, x = np.mgrid[0:height, 0:width]
        cell = self.random.choice([1, 2, 3, 5, 9])
        grey = {
            0: np.frombuffer(self.random.randbytes(height * width), np.uint8).reshape(height, width),
            1: ((x // cell) % 2) * 255,
            2: ((x // cell + y // cell) % 2) * 255,
            3: np.kron(np.frombuffer(self.random.randbytes(10_000), np.uint8).reshape(100, 100) > 127, np.ones((5, 5)))[
                :height, :width
            ]
            * 255,
        }[kind]
        return np.repeat(np.asarray(grey, np.uint8)[:height, :width, None], 3, axis=2)

    def picture(self, width: int, height: int, frame: str) -> Message:
        """A message of a camera, often damaged."""
        header, kind = Header(self.random.choice([0, 1, 2**62]), frame), self.random.random()
        if kind < 0.4:
            pixels = self.pixels(width, height)
            return Image(header, height, width, "rgb8", 3 * width, pixels.reshape(-1))
        if kind < 0.6 and min(width, height) > 0:
            file = io.BytesIO()
            Pillow.fromarray(self.pixels(width, height)).save(file, self.random.choice(["JPEG", "PNG"]))
            damaged = bytearray(file.getvalue())
            for _ in range(self.random.choice([0, 0, 1, 20])):
                damaged[self.random.randrange(len(damaged))] = self.random.randrange(256)
            length = self.random.choice([len(damaged), len(damaged), self.random.randrange(len(damaged))])
            return CompressedImage(
                header, self.random.choice(FORMATS), np.frombuffer(bytes(damaged[:length]), np.uint8)
            )
        data = np.frombuffer(self.random.randbytes(self.random.choice([0, 1, 7, 3 * width * height, 20_000])), np.uint8)
        if kind < 0.7:
            return CompressedImage(header, self.random.choice(FORMATS), data)
        step = self.random.choice([3 * width, 0, width, 2**31, 7])
        return Image(header, height, width, self.random.choice(ENCODINGS), step, data)

    def info(self, width: int, height: int, frame: str) -> CameraInfo:
        """A calibration, often a wrong one."""
        k = np.array([60.0, 0, (width - 1) / 2, 0, 60.0, (height - 1) / 2, 0, 0, 1])
        d = np.zeros(5)
        if self.random.random() < 0.4:
            k[self.random.randrange(9)] = self.number()
        if self.random.random() < 0.4:
            d = np.array([self.number() for _ in range(self.random.randrange(9))])
        if self.random.random() < 0.2:
            width, height = self.size()
        model = self.random.choice(["plumb_bob"] * 6 + ["equidistant", "", self.text()])
        return CameraInfo(Header(1, frame), height, width, model, d=d, k=k, r=np.eye(3), p=np.zeros(12))

    def transforms(self, frame: str) -> TFMessage:
        """Transforms, often wrong ones, or ones that run in a circle."""
        made = [TransformStamped(Header(1, "base"), frame, Vector3(0.0, 0.0, 1.0), Quaternion())]
        for _ in range(self.random.choice([0, 0, 1, 5])):
            parent, child = (self.random.choice([frame, "base", self.text()]) for _ in range(2))
            numbers = [self.number() for _ in range(7)]
            turn = Quaternion(*numbers[3:]) if self.random.random() < 0.5 else Quaternion()
            made.append(TransformStamped(Header(1, parent), child, Vector3(*numbers[:3]), turn))
        self.random.shuffle(made)
        return TFMessage(tuple(made))

    def request(self) -> Any:
        """A request to `/find`."""
        request: dict[str, Any] = {"timeout": 0.02}
        if self.random.random() < 0.7:
            request["name"] = self.text()
        if self.random.random() < 0.5:
            request["camera"] = self.random.choice(["top", "top", self.text()])
            if self.random.random() < 0.5:
                request["at"] = [self.number() for _ in range(self.random.choice([2, 2, 2, 3]))]
        return request

    def world(self) -> list[SceneObject]:
        """Objects with odd names and sizes."""
        shapes: Any = ("box", "sphere", "cylinder", "capsule", "plane", self.text())
        things = []
        for _ in range(self.random.randrange(20)):
            size = tuple(abs(self.number()) for _ in range(self.random.randrange(4)))
            place = pose_at((self.random.uniform(-1, 1), 0.1, 0.5))
            things.append(SceneObject(self.text(), self.random.choice(shapes), size, place))
        return things

    def detector(self, session: Session) -> Detector:
        """A detector of the package, or one that breaks its promises."""
        kind = self.random.random()
        if kind < 0.3:
            world = self.world()
            session.bus.serve(stand_in("/world/shapes"), lambda request: world)
            return SceneDetector(SceneOptions(), session)
        if kind < 0.65:
            numbers = self.random.sample(range(30), 4)
            tags = {
                f"{self.text()}{i}": Tag(id=each, size=self.random.choice([0.002, 0.04, 2.0]))
                for i, each in enumerate(numbers)
            }
            family = self.random.choice(FAMILIES[:3]) if self.random.random() < 0.3 else FAMILIES[0]
            return TagDetector(TagOptions(tags, family=family, margin=self.random.choice([0.0, 30.0])), session)
        return Liar(self)


class Liar(Detector):
    """A detector of a third party, that breaks its promises."""

    def __init__(self, made: Made) -> None:
        self._made = made

    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        made = self._made
        if made.random.random() < 0.2:
            raise made.random.choice(
                [ZeroDivisionError("x"), KeyError("cup"), MemoryError(), IbrobotError("it is dark")]
            )
        odd: list[Callable[[], Any]] = [made.number, made.text, lambda: None, lambda: [1, 2]]

        def may_be(usual: Any) -> Any:
            return made.random.choice(odd)() if made.random.random() < 0.15 else usual

        count = made.random.choice([0, 1, 3, 3_000])
        return may_be([
            Detection(
                may_be("cup"), may_be(Pose(Vector3(may_be(0.1), 0.2, 0.3), Quaternion())), may_be((0.1, 0.1)),
                may_be(0.5), may_be((Seen(may_be("top"), may_be((0.0, 1.0, 2.0, 3.0))),)),
            )
            for _ in range(count)
        ])  # fmt: skip


def attack(number: int) -> str:
    """What `/find` answers to what a number makes: `answered`, or the kind of its error.

    Raises:
        AssertionError: for an answer that is not finite or no JSON, or an error that is no answer.
    """
    made, session = Made(number), make_session()
    finder = Finder(DetectOptions(use={}), session)
    finder.start()
    detector = made.detector(session)
    finder._detectors["made"] = detector, isinstance(detector, TagDetector) or made.random.random() < 0.5
    width, height = made.size()
    frame = made.random.choice(["top_optical_frame"] * 4 + [made.text()])
    bus, picture = session.bus, made.picture(width, height, frame)
    try:
        with np.errstate(all="ignore"), patched(picture):  # numpy warns of what the answer is checked for
            bus.publish("/tf_static", made.transforms(frame), latched=True)
            bus.publish("/camera/top/camera_info", made.info(width, height, frame), latched=True)
            bus.publish("/camera/top/image_raw", picture)
            answer = bus.call("/find", made.request())
    except IbrobotError as error:
        if not str(error):
            raise AssertionError("an error without words") from error
        return type(error).__name__
    finally:
        finder.stop()
    json.dumps(plain(answer), allow_nan=False)
    return "answered"


@contextmanager
def patched(picture: Message) -> Iterator[None]:
    """Have the next picture of each camera be this one, which nobody has to wait for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finder_module, "next_pictures", lambda run, topics, timeout_s: dict.fromkeys(topics, picture))
        yield


def names(number: int) -> int:
    """How many names a text chooses, of names that a number makes."""
    made = Made(number)
    known = list(dict.fromkeys(made.text() for _ in range(made.random.randrange(30))))
    text = made.text()
    chosen = fits(text, known)
    assert set(chosen) <= set(known)
    assert text not in known or text in chosen
    return len(chosen)


def main() -> None:
    """Attack, and print what came of it."""
    outcomes = Counter[str]()
    for number in range(int(sys.argv[1])):
        try:
            outcomes[attack(number)] += 1
            names(number)
        except Exception as error:  # noqa: BLE001 - counted
            outcomes[f"BROKEN {type(error).__name__}: {str(error)[:80]}, e.g. {number}"] += 1
    for outcome, count in outcomes.most_common():
        print(f"{count:7} {outcome}")


if __name__ == "__main__":
    main()
