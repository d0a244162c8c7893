"""The card of a model's data, or of a rig: what was usual there, small enough to lie beside a checkpoint."""

from __future__ import annotations

import base64
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_provenance.files import replace_file
from ibrobot_provenance.recorded_names import CARD
from numpy.typing import NDArray

from ibrobot_core.api import Contract, DatasetError
from ibrobot_diagnose.alignment import shift_of
from ibrobot_diagnose.course import delay_of
from ibrobot_diagnose.pictures import SMALL, Grey, background, descriptors, grey, nearest, png, read_png
from ibrobot_diagnose.recorded_rig import rig_of
from ibrobot_diagnose.rig import Rig
from ibrobot_diagnose.window import Camera, Floats, Limits, Window

SCHEMA, VERSION = "ibrobot card", 1
LEVELS = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)
WAY = 16
"""Positions of the way of an episode."""
SERIES = ("seconds", "idle_start_s", "idle_end_s", "stall_s", "moving_speed", "jerk", "path")
_OF_EPISODE, _IN_ALL, _POSES = 24, 480, 200
"""Most thumbnails of an episode and of a camera, and most start and end poses."""
_RIDES = 2.0
"""Deviation of a pixel from its median over the episodes [grey values]; where nothing moves, noise is below it."""
_LARGEST = 64 << 20
"""Largest file that is read [bytes]."""


@attrs.frozen(eq=False)
class CameraCard:
    """The pictures of a camera in the data."""

    topic: str
    size: tuple[int, int]
    numbers: Mapping[str, tuple[float, ...]]
    """brightness, contrast, sharpness, clipped, red, blue (in relation to green) -> values at `LEVELS`."""
    thumbnails: NDArray[np.uint8]
    """Shape (N, 24, 32, 3)."""
    places: tuple[tuple[str, float], ...]
    """Episode and time [s] of each thumbnail."""
    poses: Floats
    """Positions of the joints at each thumbnail [rad], shape (N, J)."""
    usual_distance: float
    """Distance of nearly all thumbnails to the nearest one of another episode."""
    background: NDArray[np.uint8]
    """Median picture in grey, three equal channels, some 160 pixels wide."""
    moving: NDArray[np.uint8]
    """How much each pixel changes, likewise."""
    usual_shift: float
    """How far the backgrounds of its episodes are apart [pixels of 640]."""
    repeated_s: float
    """Longest time with equal pictures while the arm moved, in nearly all episodes [s]."""

    @cached_property
    def vectors(self) -> NDArray[np.float32]:
        """Descriptors of the thumbnails."""
        return descriptors(self.thumbnails)

    @cached_property
    def rides(self) -> bool:
        """Whether the camera is on the arm: nearly all of its picture changes."""
        return float(np.quantile(self.moving, 0.25)) >= _RIDES

    def at(self, name: str, level: float) -> float:
        """A quantile of a number."""
        return self.numbers[name][LEVELS.index(level)]


@attrs.frozen(eq=False)
class Card:
    """What was usual in a model's data."""

    rate_hz: float
    joints: tuple[str, ...]
    contract: Mapping[str, Any]
    """`Contract.canonical`."""
    episodes: int
    frames: int
    prompts: Mapping[str, int]
    """Prompt -> number of episodes."""
    state: Floats
    """Positions [rad] at `LEVELS`, shape (9, J)."""
    action: Floats
    speed: Floats
    """Measured speeds [rad/s], likewise."""
    lead: Floats
    """How far actions are from the positions of their tick [rad], likewise."""
    starts: Floats
    """Positions at the beginning of episodes [rad], shape (N, J)."""
    ends: Floats
    ways: Floats
    """The ways of episodes, each `WAY` positions of all joints one after the other [rad], shape (N, WAY * J)."""
    following: tuple[float | None, ...]
    """What is left of the error of each joint without its delay [rad rms]; None if unknown."""
    series: Mapping[str, tuple[float, ...]]
    """Names of `series_of` -> values over the episodes at `LEVELS`."""
    ages_ms: Mapping[str, float]
    """Stream -> median age of its samples on receipt [ms]; empty for data without stamps of their own."""
    cameras: Mapping[str, CameraCard] = attrs.field(factory=dict)
    """Key of an observation -> its camera."""
    norm_mode: str | None = None
    """Unit of the joints in training; None if unknown."""
    trained: Mapping[str, Any] | None = None
    """What `ibrobot train` did: policy, steps; None if the card is not of a training."""
    statistics: Mapping[str, Any] | None = None
    """Mean and deviation of state and action in the unit of the training; None if unknown."""
    rig: Rig | None = None
    """The rig at its last episode, or when it was taken; None if it is unknown."""
    limits: tuple[Limits, ...] | None = None
    """The limits of the joints in its episodes, the widest; None if they are unknown."""
    way_names: tuple[str, ...] = ()
    """Names of the episodes of `ways`; empty if unknown, as in a file."""

    def quantile(self, name: str, level: float) -> float:
        """A quantile over the episodes, of `series`."""
        return self.series[name][LEVELS.index(level)]

    def row(self, values: Floats, level: float) -> Floats:
        """The row of `state`, `action` or `speed` at a level, shape (J,)."""
        result: Floats = values[LEVELS.index(level)]
        return result

    def write(self, path: Path) -> None:
        """Write the card to a file.

        Raises:
            DatasetError: if it cannot be written.
        """
        try:
            replace_file(path, json.dumps(self.facts(), separators=(",", ":")) + "\n")
        except OSError as error:
            raise DatasetError(f"{path}: cannot be written: {error.strerror or error}") from error

    def facts(self) -> dict[str, Any]:
        """The card as a JSON object."""
        return {
            "schema": SCHEMA, "version": VERSION, "levels": list(LEVELS), "rate_hz": self.rate_hz,
            "joints": list(self.joints), "contract": self.contract, "episodes": self.episodes, "frames": self.frames,
            "prompts": dict(self.prompts), "state": _rounded(self.state), "action": _rounded(self.action),
            "speed": _rounded(self.speed), "lead": _rounded(self.lead),
            "starts": _rounded(self.starts), "ends": _rounded(self.ends), "ways": _rounded(self.ways),
            "following": list(self.following), "series": {name: list(each) for name, each in self.series.items()},
            "ages_ms": dict(self.ages_ms), "norm_mode": self.norm_mode, "trained": self.trained,
            "statistics": self.statistics,
            "cameras": {key: _camera_facts(each) for key, each in self.cameras.items()},
            "rig": None if self.rig is None else self.rig.facts(),
            "limits": None if self.limits is None else [_limits_facts(each) for each in self.limits],
        }  # fmt: skip

    @classmethod
    def read(cls, path: Path) -> Card:
        """Read a card from a file, which may come from anywhere.

        Raises:
            DatasetError: if it cannot be read, or is no card of this version.
        """
        problem: Exception
        try:
            if path.stat().st_size > _LARGEST:
                raise ValueError(f"it is larger than {_LARGEST >> 20} MiB")
            facts = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(facts, dict) or facts.get("schema") != SCHEMA:
                raise ValueError("it is no card")
            if facts.get("version") != VERSION:
                raise ValueError(f"it has version {facts.get('version')!r}; this ibrobot reads version {VERSION}")
            return cls._of(facts)
        except KeyError as error:
            problem = ValueError(f"it lacks {error.args[0]!r}")
        except (OSError, ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
            problem = error
        raise DatasetError(f"{path}: cannot be read as a card of data: {problem}")

    @classmethod
    def _of(cls, facts: Mapping[str, Any]) -> Card:
        joints = tuple(str(each) for each in facts["joints"])
        tables: dict[str, Any] = {name: _table(facts[name], len(LEVELS), len(joints), name) for name in _QUANTILES}
        poses: dict[str, Any] = {name: _table(facts[name], None, len(joints), name) for name in ("starts", "ends")}
        poses["ways"] = _table(facts["ways"], None, WAY * len(joints), "ways")
        following = tuple(None if each is None else _finite(each, "following") for each in facts["following"])
        if len(following) != len(joints):
            raise ValueError("following has not a number for each joint")
        rate = _finite(facts["rate_hz"], "rate_hz")
        if rate <= 0:
            raise ValueError("rate_hz must be above 0")
        series = {str(name): _levels(each, name) for name, each in facts["series"].items()}
        if missing := [name for name in SERIES if name not in series]:
            raise ValueError(f"series lacks {missing[0]!r}")
        if not isinstance(facts["trained"], dict | None) or not isinstance(facts["statistics"], dict | None):
            raise ValueError("trained and statistics must be objects or null")
        return cls(
            rate, joints, dict(facts["contract"]), int(facts["episodes"]), int(facts["frames"]),
            {str(text): int(count) for text, count in facts["prompts"].items()}, **tables, **poses,
            following=following, series=series,
            ages_ms={str(name): _finite(each, name) for name, each in facts["ages_ms"].items()},
            cameras={str(key): _read_camera(each, len(joints)) for key, each in facts["cameras"].items()},
            norm_mode=facts["norm_mode"], trained=facts["trained"], statistics=facts["statistics"],
            rig=None if facts.get("rig") is None else Rig.of(facts["rig"]),  # cards of before have none
            limits=None if facts.get("limits") is None else _read_limits(facts["limits"], len(joints)),
        )  # fmt: skip


_QUANTILES = ("state", "action", "speed", "lead")


def _limits_facts(limits: Limits) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in attrs.asdict(limits).items()}


def _read_limits(facts: Any, joints: int) -> tuple[Limits, ...]:
    if len(facts) != joints:
        raise ValueError("limits has not an entry for each joint")
    return tuple(
        Limits(**{name: _finite(each[name], name) for name in attrs.fields_dict(Limits) if each[name] is not None})
        for each in facts
    )


def _rounded(values: Floats) -> list[list[float]]:
    return [[float(f"{each:.6g}") for each in row] for row in values.tolist()]


def _finite(value: Any, name: str) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{name}: {value!r} is not a finite number")
    return number


def _levels(values: Any, name: str) -> tuple[float, ...]:
    numbers = tuple(_finite(each, name) for each in values)
    if len(numbers) != len(LEVELS):
        raise ValueError(f"{name} must have {len(LEVELS)} values")
    return numbers


def _table(values: Any, rows: int | None, columns: int, name: str) -> Floats:
    table = np.array(values, np.float64).reshape(-1, columns)
    if (rows is not None and len(table) != rows) or not np.isfinite(table).all():
        raise ValueError(f"{name} must have {rows or 'some'} rows of {columns} finite numbers")
    return table


def _camera_facts(camera: CameraCard) -> dict[str, Any]:
    count = len(camera.thumbnails)
    mosaic = camera.thumbnails.reshape(count * SMALL[0], SMALL[1], 3)
    return {
        "topic": camera.topic, "size": list(camera.size), "numbers": {n: list(v) for n, v in camera.numbers.items()},
        "thumbnails": _text(mosaic), "places": [list(each) for each in camera.places],
        "poses": _rounded(camera.poses), "usual_distance": camera.usual_distance,
        "background": _text(camera.background),
        "moving": _text(camera.moving), "usual_shift": camera.usual_shift, "repeated_s": camera.repeated_s,
    }  # fmt: skip


def _text(picture: NDArray[np.uint8]) -> str:
    return base64.b64encode(png(picture)).decode()


def _picture(text: str) -> NDArray[np.uint8]:
    return read_png(base64.b64decode(text, validate=True))


def _read_camera(facts: Mapping[str, Any], joints: int) -> CameraCard:
    mosaic = _picture(facts["thumbnails"])
    if mosaic.shape[1] != SMALL[1] or len(mosaic) % SMALL[0]:
        raise ValueError(f"thumbnails must be pictures of {SMALL[1]} x {SMALL[0]} pixels")
    thumbnails = mosaic.reshape(-1, *SMALL, 3)
    places = tuple((str(name), _finite(at, "places")) for name, at in facts["places"])
    middle, moving = _picture(facts["background"]), _picture(facts["moving"])
    if len(places) != len(thumbnails) or middle.shape != moving.shape:
        raise ValueError("its thumbnails and backgrounds do not belong together")
    numbers = {str(name): _levels(each, name) for name, each in facts["numbers"].items()}
    missing = [name for name in _NUMBERS if name not in numbers]
    if missing:
        raise ValueError(f"it lacks {missing[0]} of the pictures")
    height, width = (int(each) for each in facts["size"])
    others = (_finite(facts[name], name) for name in ("usual_distance", "usual_shift", "repeated_s"))
    distance, shift, repeated = others
    poses = _table(facts["poses"], len(thumbnails), joints, "poses")
    return CameraCard(
        str(facts["topic"]),
        (height, width),
        numbers,
        thumbnails,
        places,
        poses,
        distance,
        middle,
        moving,
        shift,
        repeated,
    )


_NUMBERS = ("brightness", "contrast", "sharpness", "clipped", "red", "blue")


def numbers_of(camera: Camera) -> dict[str, NDArray[np.float64]]:
    """What is known of each picture of a camera, by the names of `CameraCard.numbers`."""
    pictures, small = camera.pictures, camera.small
    means = small.mean((1, 2)) + 1.0
    return {
        **{name: np.array([getattr(each, name) for each in pictures]) for name in _NUMBERS[:4]},
        "red": means[:, 0] / means[:, 1], "blue": means[:, 2] / means[:, 1],
    }  # fmt: skip


def repeated_of(window: Window, camera: Camera) -> tuple[float, float | None]:
    """Longest time in which pictures came but were equal while the arm moved [s], and when it began [s]."""
    best: tuple[float, float | None] = (0.0, None)
    moving = window.speeds.max(axis=1, initial=0.0) > 0.1
    begin = 0
    for i in range(1, len(camera.pictures) + 1):
        if i < len(camera.pictures) and camera.pictures[i].digest == camera.pictures[begin].digest:
            continue
        since, until = camera.times_ns[begin], camera.times_ns[i - 1]
        inside = (window.ticks_ns > since) & (window.ticks_ns <= until)
        seconds = float((moving & inside).sum()) / window.contract.rate_hz
        best = max(best, (seconds, window.since(since)), key=lambda each: each[0])
        begin = i
    return best


def way_of(window: Window) -> Floats:
    """The way of an episode: positions at times evenly over it, one after the other, shape (WAY * J,)."""
    known = window.states[np.isfinite(window.states).all(axis=1)]
    result: Floats = known[np.linspace(0, len(known) - 1, WAY).round().astype(int)].ravel()
    return result


def rests_of(window: Window) -> tuple[float, float, float, float]:
    """Time without motion at the beginning, at the end, and longest in between [s], and when that begins [s]."""
    values = window.commands if "commands" in window.streams else window.states
    values = values[np.isfinite(values).all(axis=1)]
    rate = window.contract.rate_hz
    if len(values) < 3:
        return 0.0, 0.0, 0.0, 0.0
    back = max(1, round(0.2 * rate))
    moved = np.abs(values[back:] - values[:-back]).max(axis=1) > 0.01
    if not moved.any():
        return window.seconds, window.seconds, 0.0, 0.0
    first, last = int(moved.argmax()), len(moved) - 1 - int(moved[::-1].argmax())
    longest = run = begin = 0
    for i in range(first, last + 1):
        run = 0 if moved[i] else run + 1
        if run > longest:
            longest, begin = run, i - run + 1
    return first / rate, (len(moved) - 1 - last) / rate, longest / rate, begin / rate


def jerk_of(window: Window) -> float:
    """Deviation of the second differences of the positions while the arm moves, in relation to its speed [1/s]."""
    states = window.states[np.isfinite(window.states).all(axis=1)]
    if len(states) < 5:
        return 0.0
    speed = np.diff(states, axis=0)
    moving = np.abs(speed[1:]).sum(axis=1) > 0.002
    if moving.sum() < 5:
        return 0.0
    change = np.diff(speed, axis=0)[moving]
    return float(np.sqrt((change**2).mean()) / np.sqrt((speed[1:][moving] ** 2).mean())) * window.contract.rate_hz


def series_of(window: Window) -> dict[str, float]:
    """Numbers of an episode, of which a card has the quantiles; their names are `SERIES`."""
    start, end, stall, _ = rests_of(window)
    states = window.states[np.isfinite(window.states).all(axis=1)]
    return {
        "seconds": window.seconds, "idle_start_s": start, "idle_end_s": end, "stall_s": stall,
        "moving_speed": moving_speed(window), "jerk": jerk_of(window),
        "path": float(np.abs(np.diff(states, axis=0)).sum()) if len(states) > 1 else 0.0,
    }  # fmt: skip


def moving_speed(window: Window) -> float:
    """Speed of the commands, or of the arm without commands, over the joints, see `speed_of` [rad/s]."""
    values = window.commands if "commands" in window.streams else window.states
    return speed_of(np.nan_to_num(np.abs(np.diff(values, axis=0)).sum(axis=1)) * window.contract.rate_hz)


def speed_of(speeds: Floats) -> float:
    """The speed at which the way is travelled: the mean over the way, not over time, so that rests do not count."""
    way = float(speeds.sum())
    return float((speeds**2).sum()) / way if way > 0 else 0.0


def background_of(camera: Camera) -> tuple[Grey, Grey] | None:
    """Median of a camera's pictures, and what moves in them; None for fewer than three."""
    kept = [each for each in camera.kept.values() if each.shape == next(iter(camera.kept.values())).shape]
    return background(kept) if len(kept) >= 3 else None


class Maker:
    """Makes a card of episodes, one after the other, so that they need not fit into memory. Can be pickled."""

    def __init__(self) -> None:
        self._contract: Contract | None = None
        self._tables: dict[str, list[Floats]] = {name: [] for name in (*_QUANTILES, "starts", "ends", "ways")}
        self._prompts: Counter[str] = Counter()
        self._rests: list[Floats] = []
        self._series: dict[str, list[float]] = {}
        self._ages: dict[str, list[float]] = {}
        self._cameras: dict[str, _CameraMaker] = {}
        self._rig: Rig | None = None
        self._limits: tuple[Limits, ...] | None = None

    def add(self, window: Window) -> None:
        """Add an episode.

        Raises:
            DatasetError: if it has other joints than the first one, or none.
        """
        self._contract = contract = self._contract or window.contract
        if window.joints != contract.action_joints or not window.joints:
            has, wanted = (", ".join(each) or "none" for each in (window.joints, contract.action_joints))
            raise DatasetError(f"{window.name}: its joints are {has}, those of the first episode {wanted}")
        known = np.isfinite(window.states).all(axis=1)
        if not known.any():
            return
        states = window.states[known]
        self._tables["state"].append(states)
        self._tables["speed"].append(window.speeds[known])
        commands = window.commands[np.isfinite(window.commands).all(axis=1)]
        if len(commands):
            lead = np.abs(window.commands - window.states)
            self._tables["lead"].append(lead[np.isfinite(lead).all(axis=1)])
            self._tables["action"].append(commands)
            self._rests.append(delay_of(window)[1])
        self._tables["starts"].append(states[:1])
        self._tables["ends"].append(states[-1:])
        self._tables["ways"].append(way_of(window)[None])
        self._prompts[window.prompt] += 1
        self._rig = window.rig or rig_of(window) or self._rig
        self._widen(window.limits)
        for name, value in series_of(window).items():
            self._series.setdefault(name, []).append(value)
        if not window.sampled and len(window.state.times_ns):
            age = float(np.median(window.state.times_ns - window.state.stamps_ns)) / 1e6
            self._ages.setdefault("joint positions", []).append(age)
        for key, camera in window.cameras.items():
            if camera.pictures:
                self._cameras.setdefault(key, _CameraMaker(camera.topic, camera.size)).add(window, camera)
                if not window.sampled:
                    ages = np.array(camera.times_ns) - np.array(camera.stamps_ns)
                    name = f"pictures of {camera.name}"
                    self._ages.setdefault(name, []).append(float(np.median(ages)) / 1e6)

    @property
    def ways(self) -> Sequence[Floats]:
        """The ways of its episodes, see `way_of`, shape (1, WAY * J) each."""
        return self._tables["ways"]

    def _widen(self, limits: tuple[Limits, ...]) -> None:
        """Keep the widest limits of each joint."""
        if all(each == Limits() for each in limits):
            return  # no robot YAML states them
        before = self._limits or limits
        self._limits = tuple(
            Limits(
                min(a.lower, b.lower), max(a.upper, b.upper), max(a.velocity, b.velocity),
                max(a.acceleration, b.acceleration),
            )
            for a, b in zip(before, limits, strict=True)
        )  # fmt: skip

    def join(self, other: Maker) -> None:
        """Add the episodes of another maker.

        Raises:
            DatasetError: if they have other joints.
        """
        if other._contract is None:
            return
        self._contract = self._contract or other._contract
        if self._contract.action_joints != other._contract.action_joints:
            has, wanted = (", ".join(each.action_joints) for each in (other._contract, self._contract))
            raise DatasetError(f"episodes have different joints: {has}, and {wanted}")
        for name, tables in other._tables.items():
            self._tables[name] += tables
        self._prompts += other._prompts
        self._rig = other._rig or self._rig
        if other._limits is not None:
            self._widen(other._limits)
        self._rests += other._rests
        for own, theirs in ((self._series, other._series), (self._ages, other._ages)):
            for name, values in theirs.items():
                own.setdefault(name, []).extend(values)
        for key, camera in other._cameras.items():
            self._cameras.setdefault(key, _CameraMaker(camera.topic, camera.size)).join(camera)

    def card(self, **more: Any) -> Card:
        """The card.

        Raises:
            DatasetError: without an episode.
        """
        contract, tables = self._contract, self._tables
        if contract is None or not tables["state"]:
            raise DatasetError("there is no episode with joint positions to make a card of")
        joints = contract.action_joints
        joined = {name: np.concatenate(each) for name, each in tables.items() if each}
        joined = {"action": joined["state"], "lead": np.zeros((1, len(joints))), **joined}
        quantiles: dict[str, Any] = {name: np.quantile(joined[name], LEVELS, axis=0) for name in _QUANTILES}
        chosen = _thinned(len(joined["starts"]), _POSES)
        poses: dict[str, Any] = {name: joined[name][chosen] for name in ("starts", "ends", "ways")}
        series = {n: tuple(np.quantile(each or [0.0], LEVELS).tolist()) for n, each in self._series.items()}
        following: list[float | None] = [None] * len(joints)
        for j in range(len(joints)):
            known = [float(rests[j]) for rests in self._rests if np.isfinite(rests[j])]
            following[j] = float(np.quantile(known, 0.95)) if known else None
        return Card(
            contract.rate_hz, joints, contract.canonical(), len(joined["starts"]),
            len(joined["state"]), dict(self._prompts), **quantiles, **poses, following=tuple(following), series=series,
            ages_ms={name: float(np.median(each)) for name, each in self._ages.items()},
            cameras={key: each.card() for key, each in self._cameras.items()}, rig=self._rig, limits=self._limits,
            **more,
        )  # fmt: skip


def _thinned(count: int, most: int) -> NDArray[np.intp]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.intp))


class _CameraMaker:
    def __init__(self, topic: str, size: tuple[int, int]) -> None:
        self.topic, self.size = topic, size
        self._numbers: dict[str, list[NDArray[np.float64]]] = {name: [] for name in _NUMBERS}
        self._thumbnails: list[NDArray[np.uint8]] = []
        self._places: list[tuple[str, float]] = []
        self._poses: list[Floats] = []
        self._kept: list[list[NDArray[np.uint8]]] = []
        self._repeated: list[float] = []

    def add(self, window: Window, camera: Camera) -> None:
        for name, values in numbers_of(camera).items():
            self._numbers[name].append(values[_thinned(len(values), 4 * _OF_EPISODE)])
        chosen = _thinned(len(camera.pictures), _OF_EPISODE)
        poses = window.state.at(np.array(camera.times_ns, np.int64)[chosen])
        if np.isfinite(poses).any():
            poses = np.where(np.isfinite(poses), poses, np.nanmedian(poses, axis=0))  # the first picture may come first
        self._poses.append(np.nan_to_num(poses))
        for i in chosen.tolist():
            self._thumbnails.append(camera.pictures[i].small)
            self._places.append((window.name, round(window.since(camera.times_ns[i]), 3)))
        kept = list(camera.kept.values())
        self._kept.append([kept[i] for i in _thinned(len(kept), 8)])
        self._repeated.append(repeated_of(window, camera)[0])

    def join(self, other: _CameraMaker) -> None:
        for name, values in other._numbers.items():
            self._numbers[name] += values
        self._thumbnails += other._thumbnails
        self._places += other._places
        self._poses += other._poses
        self._kept += other._kept
        self._repeated += other._repeated

    def card(self) -> CameraCard:
        chosen = _thinned(len(self._thumbnails), _IN_ALL)
        thumbnails = np.stack([self._thumbnails[i] for i in chosen])
        owners = np.array([self._places[i][0] for i in chosen])
        vectors, far = descriptors(thumbnails), []
        for owner in np.unique(owners).tolist():
            others = vectors[owners != owner]
            if len(others):
                far.append(nearest(vectors[owners == owner], others)[0])
        usual = float(np.quantile(np.concatenate(far), 0.99)) if far else 0.5
        shape = self._kept[0][0].shape
        kept = [of for each in self._kept if (of := [picture for picture in each if picture.shape == shape])]
        some = [kept[i] for i in _thinned(len(kept), 12)]
        middle, moving = background([each for of in some for each in of])
        shifts = [0.0]
        for of in some[:6]:
            if len(of) >= 3 and len(some) > 1:
                shift = shift_of(middle, background(of)[0], still(moving))
                shifts += [shift.pixels] if shift is not None and shift.after > 0.3 else []
        return CameraCard(
            self.topic, self.size,
            {n: tuple(np.quantile(np.concatenate(each), LEVELS).tolist()) for n, each in self._numbers.items()},
            thumbnails, tuple(self._places[i] for i in chosen), np.concatenate(self._poses)[chosen], usual,
            _coloured(middle), _coloured(moving), float(np.quantile(shifts, 0.9)),
            float(np.quantile(self._repeated, 0.95)),
        )  # fmt: skip


def still(moving: Grey) -> Grey:
    """Weight of each pixel: small where the pictures change."""
    result: Grey = (1.0 / (1.0 + (moving / 6.0) ** 2)).astype(np.float32)
    return result


def _coloured(values: Grey) -> NDArray[np.uint8]:
    return np.repeat(np.clip(np.rint(values), 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def in_grey(picture: NDArray[np.uint8]) -> Grey:
    """A stored background in grey values."""
    return grey(picture)


def make_card(windows: Iterable[Window], **more: Any) -> Card:
    """The card of episodes.

    Args:
        windows: the episodes.
        more: further fields of the card: norm_mode, trained, statistics.

    Raises:
        DatasetError: if there is none, or they have different joints.
    """
    maker = Maker()
    for window in windows:
        maker.add(window)
    return maker.card(**more)


def with_card(folders: Sequence[Path]) -> Path | None:
    """The first card in these folders; None if none has one."""
    return next((folder / CARD for folder in folders if (folder / CARD).is_file()), None)
