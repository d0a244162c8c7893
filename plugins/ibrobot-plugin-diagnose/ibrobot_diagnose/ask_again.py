"""The model asked again: what it was asked in a recording, and with observations that are changed."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Contract, Frame, IbrobotError, Policy, RecorderError
from ibrobot_core.app import (
    FrameAssembler,
    RobotConfig,
    build_policy,
    from_document,
    installed_plugins,
    policy_units,
)
from ibrobot_diagnose.window import Asked, Floats, Window

ACTION = "action"
_MOST = 8
"""Frames on which the model is asked with changed observations."""

type Values = Mapping[str, NDArray[Any]]


@attrs.frozen(eq=False)
class Again:
    """A request asked again."""

    asked: Asked
    missing: frozenset[str]
    """Observations that the recording lacks at its time."""
    chunk: Floats
    """The actions of the second answer [rad]."""

    @property
    def equal(self) -> bool:
        """Whether both answers are equal, bit for bit."""
        return self.chunk.shape == self.asked.chunk.shape and self.chunk.tobytes() == self.asked.chunk.tobytes()

    @property
    def difference(self) -> float:
        """Largest difference of the answers [rad]; infinite for other shapes."""
        if self.chunk.shape != self.asked.chunk.shape:
            return float("inf")
        return float(np.abs(self.chunk - self.asked.chunk).max(initial=0.0))


class Model:
    """The model of a run, loaded, with the frames of its requests.

    Args:
        window: the run.
        episode: its recording.
        config: the robot.
        name: the model's name in it.
    """

    def __init__(self, window: Window, episode: Path, config: RobotConfig, name: str) -> None:
        self.window, self._episode, self._name = window, episode, name
        model = config.models[name]
        self.contract = Contract.from_config(config, model.extra_observations)
        self.policy: Policy = build_policy(config, installed_plugins(), name, self._seed)
        calibration = json.loads(window.metadata.get("calibration", "{}"))
        joined = {joint: numbers for each in calibration.values() for joint, numbers in each.items()}
        mode = model.norm_mode or self.policy.spec.norm_mode or "radians"
        self._units = policy_units(self.contract)(mode, self.contract, joined, window.document)
        if window.mode.get("dispatch", {}).get("strategy") == "rtc":
            raise RecorderError(
                f"{episode}: its policy continued the plan that it was given (strategy rtc), which is not recorded, so "
                "it "
                "cannot be asked again"
            )

    @property
    def _seed(self) -> int:
        return int(self.window.metadata.get("seed", "0"))

    def load(self) -> None:
        """Load the weights.

        Raises:
            PolicyError: if they cannot be loaded.
        """
        self.policy.load()
        self.policy.reset(self._seed)

    def close(self) -> None:
        """Release the model."""
        self.policy.close()

    def frames(self, asked: Sequence[Asked]) -> Iterator[Frame]:
        """The frame of each request, as the model was given it, in radians.

        Raises:
            ContractError: if the recording does not fit the contract.
        """
        spec, step_ns = self.policy.spec, self.contract.step_ns
        assembler = FrameAssembler(self.contract, tuple(dict.fromkeys((*spec.observations, *self._units.needs))))
        first = min(each.answer.observed_ns for each in asked)
        wanted = sorted({each.answer.observed_ns for each in asked})
        ticks = {t_ns - step_ns * back for t_ns in wanted for back in range(spec.history + 1)}
        known: dict[int, Frame] = {}
        with closing(installed_plugins().open_episode(self._episode)) as reader:
            messages = reader.messages(set(assembler.topics()) & set(reader.summary().topics))
            coming = next(messages, None)
            for t_ns in sorted(tick for tick in ticks if tick >= first):
                while coming is not None and coming.received_ns <= t_ns:
                    assembler.take(coming.topic, coming.message, coming.received_ns)
                    coming = next(messages, None)
                known[t_ns] = assembler.frame(t_ns)
                if t_ns not in wanted:
                    continue
                past: list[Frame] = []
                for back in range(1, spec.history + 1):
                    before = known.get(t_ns - back * step_ns)
                    if before is None or before.missing:
                        break
                    past.insert(0, before)
                yield attrs.evolve(known[t_ns], history=tuple(past))
                known = {at: frame for at, frame in known.items() if at > t_ns - (spec.history + 1) * step_ns}

    def answer(self, frame: Frame, prompt: str) -> Floats:
        """The model's actions for a frame [rad], shape (N, A).

        Raises:
            PolicyError: if an observation is missing, or the model fails.
        """
        frame = self._units.frame(attrs.evolve(frame, prompt=prompt))
        outputs = self.policy.infer(self.policy.preprocess(frame))
        actions = np.array(self.policy.postprocess(outputs), dtype=np.float64)
        result: Floats = np.asarray(self._units.radians(ACTION, actions), np.float64)
        return result

    def again(self) -> Iterator[Again]:
        """Ask every request that was answered again."""
        asked = sorted(
            (each for each in self.window.asked if len(each.chunk)), key=lambda each: each.answer.observed_ns
        )
        if not asked:
            return
        by_time: dict[int, list[Asked]] = {}
        for each in asked:
            by_time.setdefault(each.answer.observed_ns, []).append(each)
        for frame in self.frames(asked):
            for each in by_time[frame.stamp_ns]:
                yield Again(each, frame.missing, self.answer(frame, each.answer.prompt))

    def whose(self, first: Again) -> str:
        """Why an answer differs, in words."""
        answer = first.asked.answer
        here, there = self.policy.weights(), answer.weights
        if here and there and here != there:
            return f"the weights are others: {there} acted, {here} was asked"
        if self.policy.fingerprint() != self.window.policy.get("fingerprint", self.policy.fingerprint()):
            return "the checkpoint is another: its configuration or statistics differ from those that acted"
        place = self.policy.identity()
        if place and answer.server and place != answer.server:
            return f"the library or processor is another: {answer.server} acted, {place} was asked"
        if first.missing:
            return f"the recording lacks {', '.join(sorted(first.missing))} at that time"
        if first.difference < 1e-3:
            return "rounding: another processor, or another number of threads (`threads` of the model)"
        return "an observation: the recording has another picture or state than the model was given"


def model_of(window: Window, episode: Path, given: str) -> Model:
    """The model of a run.

    Args:
        window: the run.
        episode: its recording.
        given: path of a checkpoint, or the name of a model in the recorded robot YAML; empty for the one that acted.

    Raises:
        RecorderError: if the recording does not say which model acted, or has no such model.
        IbrobotError: if the model cannot be made.
    """
    models = dict(window.document.get("models") or {})
    name = str(window.policy.get("model", ""))
    path = Path(given) if given else None
    if path is not None and not path.exists():
        name, path = given, None
    if name not in models:
        known = ", ".join(models) or "none"
        raise RecorderError(
            f"{episode}: has no model {name!r}; its robot YAML has: {known}; or give the checkpoint's folder"
        )
    document = dict(window.document)
    if path is not None:
        models[name] = {**models[name], "path": str(path.absolute())}
        document["models"] = models
    return Model(window, episode, _config(window, document), name)


def _config(window: Window, document: Mapping[str, Any]) -> RobotConfig:
    simulated = bool(document.get("simulation")) and window.metadata.get("calibration", "{}") == "{}"
    return from_document(document, source=Path("recorded.yaml"), sim=simulated)


@contextmanager
def loaded(model: Model) -> Iterator[Model]:
    """Load a model, and release it at the end."""
    model.load()
    try:
        yield model
    finally:
        model.close()


@attrs.frozen
class Effect:
    """How far the answers move if something is changed."""

    what: str
    change: str
    per_joint: Mapping[str, float]
    """Mean movement of each joint [rad]."""

    @property
    def largest(self) -> float:
        """Movement of the joint that moves most [rad]."""
        return max(self.per_joint.values(), default=0.0)


def effects(model: Model) -> list[Effect]:
    """How far the model's answers move if its observations are changed, largest first."""
    asked = [each for each in model.window.asked if len(each.chunk)]
    chosen = [asked[i] for i in np.unique(np.linspace(0, len(asked) - 1, min(_MOST, len(asked))).round().astype(int))]
    frames = list(model.frames(chosen))
    frames = [each for each in frames if not each.missing]
    if not frames:
        return []
    prompt = model.window.prompt
    plain = [model.answer(frame, prompt) for frame in frames]
    joints = model.contract.action_names
    listed = []
    for what, how, change in _changes(model, frames):
        try:
            moved = [
                np.abs(model.answer(_changed(frame, i, change), prompt) - plain[i]).mean(axis=0)
                for i, frame in enumerate(frames)
            ]
        except IbrobotError:  # some models refuse what cannot be
            continue
        means = np.mean(moved, axis=0)
        listed.append(Effect(what, how, dict(zip(joints, map(float, means), strict=False))))
    return sorted(listed, key=lambda each: -each.largest)


@attrs.frozen(eq=False)
class Examined:
    """A model that was asked again."""

    again: tuple[Again, ...]
    effects: tuple[Effect, ...]
    whose: str
    """Why the first answer that differs does; empty if all are equal."""
    identity: str
    """Library and device that computed the answers."""


def examine(model: Model) -> Examined:
    """Ask a model again, and with changed observations.

    Raises:
        IbrobotError: if it cannot be loaded, or fails.
    """
    with loaded(model):
        again = tuple(model.again())
        first = next((each for each in again if not each.equal), None)
        whose = model.whose(first) if first is not None else ""
        return Examined(again, tuple(effects(model)), whose, model.policy.identity())


type _Change = Callable[[int, Values], Values]


def _changed(frame: Frame, i: int, change: _Change) -> Frame:
    """A frame, the i-th, and its history with a change."""
    history = tuple(attrs.evolve(each, values={**each.values, **change(i, each.values)}) for each in frame.history)
    return attrs.evolve(frame, values={**frame.values, **change(i, frame.values)}, history=history)


def _one(key: str, change: Callable[[int, NDArray[Any]], NDArray[Any]]) -> _Change:
    """A change of one observation."""
    return lambda i, values: {key: change(i, values[key])}


def _replaced(by: Sequence[NDArray[Any]]) -> Callable[[int, NDArray[Any]], NDArray[Any]]:
    return lambda i, value: by[i % len(by)]


def _exchanged(one: str, other: str) -> _Change:
    return lambda i, values: {one: values[other], other: values[one]}


_OF_PICTURES: Mapping[str, Callable[[int, NDArray[Any]], NDArray[Any]]] = {
    "black": lambda i, value: np.zeros_like(value),
    "BGR for RGB": lambda i, value: np.ascontiguousarray(value[..., ::-1]),
    "upside down": lambda i, value: np.ascontiguousarray(value[::-1, ::-1]),
    "shifted by a tenth": lambda i, value: np.roll(value, value.shape[1] // 10, axis=1),
}
_OF_VECTORS: Mapping[str, Callable[[int, NDArray[Any]], NDArray[Any]]] = {
    "in degrees": lambda i, value: value * np.float32(180 / np.pi),
    "in reverse order": lambda i, value: value[::-1].copy(),
    "shifted by 0.2 rad": lambda i, value: value + np.float32(0.2),
}


def _changes(model: Model, frames: Sequence[Frame]) -> Iterator[tuple[str, str, _Change]]:
    """Each change: what, how, and the changed values of a frame by its number and values."""
    observations = model.policy.spec.observations
    cameras = [key for key, shape in observations.items() if len(shape) == 3]
    for key in observations:
        name = key.rpartition(".")[2]
        shown = [frame.values[key] for frame in frames]
        half = len(shown) // 2
        mean = np.mean([each.astype(np.float64) for each in shown], axis=0).astype(shown[0].dtype)
        if half:
            yield name, "of another time", _one(key, _replaced([*shown[half:], *shown[:half]]))
        yield name, "replaced by its mean", _one(key, _replaced([mean]))
        for how, change in (_OF_PICTURES if key in cameras else _OF_VECTORS).items():
            yield name, how, _one(key, change)
    for one, other in itertools.combinations(cameras, 2):
        if frames[0].values[one].shape == frames[0].values[other].shape:
            yield f"{one.rpartition('.')[2]} and {other.rpartition('.')[2]}", "exchanged", _exchanged(one, other)
