"""The model asked again: what it was asked in a recording, and with observations that are changed."""

from __future__ import annotations

import itertools
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from ibrobot_calibration.joint_units import recorded_units
from ibrobot_provenance.recorded_names import ATTENTION
from numpy.typing import NDArray

from ibrobot_core.api import (
    ACTION,
    Context,
    Contract,
    Engine,
    Frame,
    ModelContext,
    Policy,
    RealClock,
    RecorderError,
    Tensors,
    Transport,
)
from ibrobot_core.app import FrameAssembler, RobotConfig, from_document, installed_plugins
from ibrobot_diagnose.pictures import Shown, reddened
from ibrobot_diagnose.window import Asked, Floats, Window

_log = logging.getLogger("ibrobot.diagnose")
_MOST, _MOST_OF_PARTS = 8, 3
"""Frames on which the model is asked with changed observations, and with changed parts of a vector."""
_ADDRESSES = ("url", "address", "server")
"""Options of policies that name a server of their own."""
_HERE = "monolithic"
"""The engine that asks the model in this process."""
_PATIENCE_NS = 600_000_000_000

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
        asked_there: ask the servers that the robot's transport connects to, and load no weights here.
    """

    def __init__(
        self, window: Window, episode: Path, config: RobotConfig, name: str, *, asked_there: bool = False
    ) -> None:
        self.window, self._episode, self._name, self._config = window, episode, name, config
        self._asked_there = asked_there
        self._engine: Engine | None = None
        self._transport: Transport | None = None
        self._requests = itertools.count(1)
        model = config.models[name]
        self.contract = Contract.from_config(config, model.extra_observations)
        self.policy: Policy = installed_plugins().build_policy(config, name, self._seed)
        calibration = json.loads(window.metadata.get("calibration", "{}"))
        joined = {joint: numbers for each in calibration.values() for joint, numbers in each.items()}
        mode = model.norm_mode or self.policy.spec.norm_mode or "radians"
        self._units = recorded_units(model.units, mode, self.contract, joined, window.document)
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
        """Load the weights, or find the server.

        Raises:
            PolicyError: if they cannot be loaded, or no server has the model.
        """
        config, registry = self._config, installed_plugins()
        inference = config.control_modes[self.window.metadata["mode"]].inference
        if self._asked_there and config.transport is not None:
            context = Context.of(config, "transport", RealClock(), self._seed)
            self._transport = registry.create("transport", config.transport.type, config.transport.options, context)
        kind = inference.type if inference is not None and self._asked_there else _HERE
        options = registry.find("engine", kind).options()
        if inference is not None and kind == inference.type:
            options = inference.options
        model = ModelContext(config, self.policy, self._transport)
        context = Context.of(config, self._name, RealClock(), self._seed, model=model)
        self._engine = engine = registry.create("engine", kind, options, context)
        engine.start()
        self.policy.reset(self._seed)
        engine.reset(self._seed)

    @property
    def engine(self) -> Engine:
        """What runs the model; loaded."""
        assert self._engine is not None
        return self._engine

    def close(self) -> None:
        """Release the model."""
        if self._engine is not None:
            self._engine.close()
        if self._transport is not None:
            self._transport.close()
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
        actions = np.array(self.policy.postprocess(self._outputs(frame, prompt)), dtype=np.float64)
        result: Floats = np.asarray(self._units.radians(ACTION, actions), np.float64)
        return result

    def attention(self, frame: Frame) -> Mapping[str, Floats]:
        """What the model attends to in each picture, key -> weights, shape (h, w); empty for one that does not say."""
        if frame.missing:
            return {}
        outputs = self._outputs(frame, self.window.prompt)
        looks = {name: np.asarray(array, np.float64) for name, array in outputs.items() if name.startswith(ATTENTION)}
        return {name.removeprefix(ATTENTION): each for name, each in looks.items()}

    def _outputs(self, frame: Frame, prompt: str) -> Tensors:
        frame = self._units.frame(attrs.evolve(frame, prompt=prompt))
        deadline_ns = time.monotonic_ns() + _PATIENCE_NS
        return self.engine.infer(self.policy.preprocess(frame), next(self._requests), deadline_ns)

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

    def whose(self, again: Sequence[Again]) -> str:
        """Why answers differ, in words; empty if all are equal."""
        differing = [each for each in again if not each.equal]
        return next(self._reasons(differing, len(again)), "") if differing else ""

    def _reasons(self, differing: Sequence[Again], count: int) -> Iterator[str]:
        """Whose the difference may be, the surest first."""
        first = differing[0]
        answer, stats, at_s = first.asked.answer, self.engine.stats, self.window.since(first.asked.answer.observed_ns)
        if stats.weights and answer.weights and stats.weights != answer.weights:
            yield f"the weights are others: {answer.weights} acted, {stats.weights} was asked"
        if self.policy.fingerprint() != self.window.policy.get("fingerprint", self.policy.fingerprint()):
            yield "the checkpoint's processors (statistics, features) are others, with the same weights"
        if changed := self._changed_contract():
            yield f"the contract is another: {changed} of the robot YAML is not that of the recording"
        yield from _differences(answer.server, stats.server)
        if first.missing:
            yield f"the recording lacks {', '.join(sorted(first.missing))} at {at_s:.2f} s"
        if len(differing) == count and first.difference < 1e-3:
            yield "rounding: another processor, other versions of libraries, or another number of threads (`threads`)"
        yield (
            "an observation: model, library and processor are the same, so the recording has another picture or state "
            f"at {at_s:.2f} s than the model was given"
        )

    def _changed_contract(self) -> str:
        """What of the contract differs from the recorded one; empty if nothing does."""
        recorded, asked = self.window.contract, self.contract
        if recorded.rate_hz != asked.rate_hz:
            return "rate_hz"
        if recorded.action_joints != asked.action_joints:
            return "action"
        known = {part.key for part in recorded.observation_parts}
        keys = [key for key in self.policy.spec.observations if key in known]
        return next((key for key in keys if recorded.parts(key) != asked.parts(key)), "")


def _differences(acted: str, asked: str) -> Iterator[str]:
    """What differs between the identities of those who computed the answers: a program, a library, or a processor."""
    one, other = (each.rpartition(": ")[2].split(", ") for each in (acted, asked))
    if not acted or not asked:
        return
    if len(one) != len(other):
        yield f"the program is another: {acted} acted, {asked} was asked"
    for here, there in zip(one, other, strict=False):
        if here != there:
            same = here.split(" ")[0] == there.split(" ")[0]
            what = "number of threads" if here.startswith("threads ") else "library" if same else "processor"
            yield f"the {what} is another: {here} acted, {there} was asked"


def model_of(window: Window, episode: Path, given: str, server: str = "") -> Model:
    """The model of a run.

    Args:
        window: the run.
        episode: its recording.
        given: path of a checkpoint, or the name of a model in the recorded robot YAML; empty for the one that acted.
        server: address of the server that computes its answers; empty to load its weights here.

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
    if not server:
        return Model(window, episode, _config(window, document), name)
    options = attrs.fields_dict(installed_plugins().find("policy", models[name]["type"]).options)
    if own := next((each for each in _ADDRESSES if each in options), None):
        document["models"] = {**models, name: {**models[name], own: server}}
    elif document.get("transport"):
        document["transport"] = {**document["transport"], "connect": [server], "listen": []}
    else:
        raise RecorderError(
            f"{episode}: its model {name!r} was not computed by a server: its robot YAML names no transport; ask it "
            "without --server"
        )
    return Model(window, episode, _config(window, document), name, asked_there=own is None)


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
    frames = [each for each in model.frames(chosen) if not each.missing]
    if not frames:
        return []
    prompt = model.window.prompt
    plain = [model.answer(frame, prompt) for frame in frames]
    few = range(0, len(frames), max(1, len(frames) // _MOST_OF_PARTS))
    changes = [(range(len(frames)), each) for each in _changes(model, frames)]
    changes += [(few, each) for each in _changes_of_parts(model, frames)]
    listed = []
    for numbers, (what, how, change) in changes:
        try:
            with np.errstate(invalid="raise"):  # as 0 / 0 in the rotation of a quaternion of zeros
                answers = {i: model.answer(_changed(frames[i], i, change), prompt) for i in numbers}
            moved = [np.abs(answer - plain[i]).mean(axis=0) for i, answer in answers.items()]
        except Exception as error:  # noqa: BLE001 - what cannot be, e.g. a rotation of zeros, may raise anything
            _log.info("the model gives no answer with %s %s: %s", what, how, error)
            continue
        means = np.mean(moved, axis=0)
        listed.append(Effect(what, how, dict(zip(model.contract.action_names, map(float, means), strict=False))))
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
    looks: tuple[Shown, ...] = ()
    """Pictures with what the model attends to in red, if it can say."""


def examine(model: Model) -> Examined:
    """Ask a model again, and with changed observations.

    Raises:
        IbrobotError: if it cannot be loaded, or fails.
    """
    with loaded(model):
        again = tuple(model.again())
        changed, looks = effects(model), tuple(looks_of(model))
        return Examined(again, tuple(changed), model.whose(again), model.engine.stats.server, looks)


def looks_of(model: Model) -> Iterator[Shown]:
    """Pictures of the first, the middle and the last request, with what the model attends to in red."""
    asked = [each for each in model.window.asked if len(each.chunk)]
    for frame in model.frames([asked[i] for i in sorted({0, len(asked) // 2, len(asked) - 1})]) if asked else ():
        for key, weights in model.attention(frame).items():
            share, at_s = 100 * float(weights.sum()), model.window.since(frame.stamp_ns)
            title = f"{key.rpartition('.')[2]} at {at_s:.1f} s: {share:.0f} % of what the model attends to"
            yield Shown(title, reddened(np.asarray(frame.values[key], np.uint8), weights))


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
    "mirrored": lambda i, value: np.ascontiguousarray(value[:, ::-1]),
    "shifted by a tenth": lambda i, value: np.roll(value, value.shape[1] // 10, axis=1),
}
_OF_VECTORS: Mapping[str, Callable[[int, NDArray[Any]], NDArray[Any]]] = {
    "replaced by zeros": lambda i, value: np.zeros_like(value),
    "in degrees": lambda i, value: value * np.float32(180 / np.pi),
    "from -100 to 100": lambda i, value: value * np.float32(100 / np.pi),
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


def _changes_of_parts(model: Model, frames: Sequence[Frame]) -> Iterator[tuple[str, str, _Change]]:
    """As `_changes`, of each element of the vectors alone."""
    for key, shape in model.policy.spec.observations.items():
        if len(shape) != 1:
            continue
        names = [name for part in model.contract.parts(key) for name in part.feature.names or ()]
        shown = [frame.values[key] for frame in frames]
        half, mean = len(shown) // 2, np.mean([each.astype(np.float64) for each in shown], axis=0)
        for j, name in enumerate(names if len(names) == shape[0] else ()):
            by: dict[str, Sequence[float]] = {
                "of another time": [float(each[j]) for each in (*shown[half:], *shown[:half])],
                "replaced by its mean": [float(mean[j])], "replaced by zero": [0.0],
                "shifted by 0.2 rad": [float(each[j]) + 0.2 for each in shown],
            }  # fmt: skip
            for how, values in by.items():
                if half or how != "of another time":
                    yield f"{key.rpartition('.')[2]} {name.removesuffix('.pos')}", how, _one(key, _element(j, values))


def _element(j: int, values: Sequence[float]) -> Callable[[int, NDArray[Any]], NDArray[Any]]:
    def change(i: int, value: NDArray[Any]) -> NDArray[Any]:
        changed = value.copy()
        changed[j] = values[i % len(values)]
        return changed

    return change
