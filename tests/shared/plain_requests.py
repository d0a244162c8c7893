"""Requests in plain data for declared services: mostly of the right shape, with values at every extreme."""

from __future__ import annotations

import json
import random
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import attrs
import numpy as np
from ibrobot_ros2 import decode, encode

from ibrobot_core.config.load import load_config
from ibrobot_core.convert import is_array, is_literal, is_mapping, is_sequence, is_union
from ibrobot_core.errors import IbrobotError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import (
    MESSAGE_TYPES,
    CameraInfo,
    Header,
    Image,
    Message,
    ModelAnswer,
    PointCloud2,
    PointField,
    RobotStatus,
)
from ibrobot_core.options import fields
from ibrobot_core.plugins import installed_plugins
from ibrobot_core.services import RequestLimits, Service

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / "configs" / "so101_blind.yaml"
POSITION = "executors: [arm_position, gripper_position]"
EVERYTHING = (
    "world={scene: true, clouds: {camera: {topic: /camera/points, when_stale: forget}}}",
    "tasks={}",
    "mcp={http: false}",
    "detect={use: {scene: {}}}",
    "recording={type: mcap, root: episodes}",
    "episodes={keep: highlights}",
    "teleoperation={web: {type: web}, twist: {type: twist}}",
    f"control_modes.teleop={{{POSITION}, teleop: web}}",
    f"control_modes.servo={{{POSITION}, teleop: twist}}",
    "control_modes.model_inference.inference={model: scripted_pick, intervene: web}",
    "default_control_mode=moveit_planning",
    "simulation.default_control_mode=moveit_planning",
)
"""Overrides with which a run of `CONFIG` offers every service and reads every kind of topic."""

SECRET = "IBROBOT_FUZZ_SECRET"
NUMBERS: Sequence[Any] = (
    0, 1, -1, 2, 0.5, -0.5, 0.1, 0.01, 1e-5, 1e-300, 5e-324, 1.0000001, 3.2, 100.0, 1e9, 1e300, 1.7e308, 2**31, 2**63,
    -(2**63), 10**400, float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
BASES: Mapping[str, Message] = {
    each.ros_type: each
    for each in (
        PointCloud2(
            Header(0, "base"),
            1,
            50,
            tuple(PointField(name, 4 * i, 7) for i, name in enumerate("xyz")),
            False,
            12,
            600,
            np.full(150, 0.2, np.float32).view(np.uint8),
        ),
        Image(Header(0, "base"), 4, 6, "16UC1", 12, np.full(24, 300, np.uint16).view(np.uint8)),
        CameraInfo(Header(0, "base"), 4, 6, "plumb_bob", np.zeros(5), np.array([5.0, 0, 3, 0, 5, 2, 0, 0, 1])),
        RobotStatus(Header(0, ""), "so101", "idle"),
        ModelAnswer(
            Header(0, ""), 1, 0, "act", "", "", "", "used", "", 20.0, 10.0, 0.0, 33_333_333, ("gripper",), np.zeros(1)
        ),
    )
}
"""Messages that make sense; generated ones differ from them in some fields."""
TEXTS = (
    "", "home", "rest", "up", "xyz=0.2,0.0,0.1", "xyz=1e308,0,0", "xyz=nan,0,0", "shoulder_pan=0.5",
    "shoulder_pan=1e300",
    "moveit_planning", "teleop", "idle", "success", f"${{{SECRET}}}", "\\u0024{" + SECRET + "}", "~/x", "/etc/passwd",
    "package://ibrobot_core/../x.stl", "a" * 300 + ".stl", "a" * 1001, "a" * 200_000, "\x00", "\x1b[2J", "\ud800",
    "ü 漢",
    "{name: cube}", "steps: [{move: {pose: home}}]", f"steps: [{{move: {{pose: '${{{SECRET}}}'}}}}]", "box", "cube",
    "table", "gripper", "shoulder_pan", "base",
)  # fmt: skip
NAMES = ("shoulder_pan", "elbow_flex", "gripper", "pan", "cube", "x", "", "a" * 1001, "\x00")
_MOST_CHARACTERS = 1_500_000
"""More takes the client longer to encode than the robot to refuse."""
LENGTHS = (0, 1, 2, 3, 3, 3, 4, 6, 21, 101, 2001, 30_000)


@attrs.frozen
class Offered:
    """What a run offers to other machines."""

    services: Mapping[str, Service[Any, Any]]
    modes: Mapping[str, str]
    """Service -> the first mode in which it is served."""
    topics: Mapping[str, frozenset[str]]
    """Topic that it reads and does not publish -> its types."""


@contextmanager
def everything() -> Iterator[Runtime]:
    """A run in lockstep that offers everything, at its beginning."""
    registry = installed_plugins()
    config = load_config(CONFIG, overrides=list(EVERYTHING), sim=True, registry=registry)
    runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, by_operator=True)))
    runtime.start()
    try:
        yield runtime
    finally:
        runtime.stop()
    runtime.raise_failure()


def offered() -> Offered:
    """What a run offers in all its modes, as its bus lists it."""
    services: dict[str, Service[Any, Any]] = {}
    modes: dict[str, str] = {}
    with everything() as runtime:
        bus = runtime.session.bus
        for mode in runtime.session.config.control_modes:
            runtime.switch_mode(mode)
            for _ in range(5):
                runtime.step()
            for name, service in bus.services().items():
                services[name] = service
                modes.setdefault(name, mode)
        topics = {topic: bus.expected(topic) for topic in bus._expected if topic not in bus.topics()}
    return Offered(services, modes, topics)


def declared() -> dict[str, Service[Any, Any]]:
    """The services that core and the plugins declare, found in their source."""
    found: dict[str, Service[Any, Any]] = {}
    for package in (ROOT / "ibrobot_core", *ROOT.glob("plugins/*/*ibrobot*")):
        for path in package.rglob("*.py"):
            if " = Service(" in path.read_text(encoding="utf-8"):
                module = import_module(".".join(path.relative_to(package.parent).with_suffix("").parts))
                services = (each for each in vars(module).values() if isinstance(each, Service))
                found |= {each.name: each for each in services if each.name.startswith("/")}
    return found


class Requests:
    """Makes requests.

    Args:
        seed: equal seeds make equal requests.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._left = 0

    def request(self, service: Service[Any, Any]) -> Any:
        """A request to a service."""
        self._left = 40_000
        if self._random.random() < 0.05:
            return self._anything(3)
        made = self._of(service.request, 6)
        if isinstance(made, dict) and service.alone and self._random.random() < 0.5:
            return made.get(service.alone)
        return made

    def message(self, types: frozenset[str]) -> Message:
        """A message as it arrives from a network: mostly of one of the types, with fields at every extreme."""
        chosen = sorted(types if self._random.random() < 0.9 else MESSAGE_TYPES)
        kind = MESSAGE_TYPES[self._random.choice(chosen)]
        service: Service[Any, Any] = Service("", kind, type(None), limits=RequestLimits(10**6, 10**6, 10))
        while True:
            try:
                if (base := BASES.get(kind.ros_type)) is not None:
                    made = attrs.evolve(base, **self._changes(fields(kind)))
                else:
                    made = service.read(self.request(service))
                return decode(kind.ros_type, encode(made))
            except (IbrobotError, ValueError, TypeError, AttributeError, OverflowError, struct.error):
                continue  # no such message can be sent

    def _changes(self, known: Mapping[str, attrs.Attribute[Any]]) -> dict[str, Any]:
        """Values for some fields of a message."""
        names = self._random.sample(sorted(known), self._random.randint(0, min(3, len(known))))
        return {name: self._change(known[name].type) for name in names}

    def _change(self, kind: Any) -> Any:
        if is_array(kind):
            dtype = np.dtype(get_args(get_args(kind)[-1])[0] if get_args(get_args(kind)[-1]) else get_args(kind)[-1])
            return np.frombuffer(self._random.randbytes(self._length() * dtype.itemsize), dtype)
        if attrs.has(kind):
            made: Any = kind()
            return attrs.evolve(made, **self._changes(fields(kind)))
        return self._of(kind, 3)

    def _of(self, kind: Any, depth: int) -> Any:  # noqa: PLR0911 - one case per kind of type
        chosen = self._random
        if chosen.random() < 0.03 or depth == 0:
            return self._anything(2)
        if is_union(kind):
            return self._of(chosen.choice(get_args(kind)), depth)
        if is_literal(kind):
            return chosen.choice((*get_args(kind), *TEXTS))
        if is_array(kind):
            return [self._number() for _ in range(self._length())]
        if is_mapping(kind):
            return {name: self._of(get_args(kind)[1], depth - 1) for name in chosen.sample(NAMES, chosen.randint(0, 6))}
        if is_sequence(kind):
            return self._list(get_args(kind), depth)
        if kind in (int, float):
            return self._number()
        if kind is bool:
            return chosen.random() < 0.5
        if kind is type(None):
            return None
        if not attrs.has(kind):
            return chosen.choice(TEXTS)
        known = fields(kind)
        given = [name for name, field in known.items() if chosen.random() < (0.3, 0.97)[field.default is attrs.NOTHING]]
        if "xyz" in known and "pose" in known and chosen.random() < 0.8:  # a goal has one of them
            given = [chosen.choice(("pose", "joints", "xyz")), *(name for name in given if "tolerance" in name)]
        made = {name: self._of(known[name].type, depth - 1) for name in given}
        if chosen.random() < 0.03:
            made[chosen.choice(NAMES)] = self._anything(2)
        return made

    def _list(self, kinds: tuple[Any, ...], depth: int) -> list[Any]:
        fixed = len(kinds) > 1 and kinds[1] is not Ellipsis
        if fixed and self._random.random() < 0.9:
            return [self._of(kind, depth - 1) for kind in kinds]
        length = self._length()
        one = [self._of(kinds[0], depth - 1) for _ in range(min(length, 3))]
        most = _MOST_CHARACTERS * len(one) // max(len(json.dumps(one)), 1)
        return (one * length)[: max(min(length, most), len(one))]

    def _length(self) -> int:
        """Number of items; the whole request must stay within what a network carries quickly."""
        length = min(self._random.choice(LENGTHS), max(self._left, 0))
        self._left -= length
        return length

    def _number(self) -> Any:
        if self._random.random() < 0.6:
            return round(self._random.uniform(-0.3, 0.3), 3)
        return self._random.choice(NUMBERS)

    def _anything(self, depth: int) -> Any:  # noqa: PLR0911 - one case per kind of data
        chosen = self._random
        match chosen.randint(0, 6 if depth else 3):
            case 0:
                return self._number()
            case 1:
                return chosen.choice(TEXTS)
            case 2:
                return None
            case 3:
                return chosen.random() < 0.5
            case 4:
                return [self._anything(depth - 1) for _ in range(chosen.randint(0, 4))]
            case 5:
                return {chosen.choice(NAMES): self._anything(depth - 1) for _ in range(3)}
        deep: Any = 1
        self._left -= 1000
        for _ in range(chosen.choice((5, 20, 900))):
            deep = [deep]
        return deep
