"""Policy `lerobot`: a LeRobot checkpoint in three pure steps; only `load` and `infer` need torch."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, override

import numpy as np
from ibrobot_provenance.recorded_names import ATTENTION
from numpy.typing import NDArray

from ibrobot_core.api import Context, Frame, Header, Image, PictureCodec, Policy, PolicyError, PolicySpec, Tensors
from ibrobot_lerobot.checkpoint import (
    ACTION,
    POSTPROCESSOR,
    PREPROCESSOR,
    check_weights,
    hash_weights,
    read_checkpoint,
)
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.quiet import cause, held_back
from ibrobot_lerobot.steps import read_steps
from ibrobot_lerobot.versions import INSTALL, installed, untested

if TYPE_CHECKING:
    from ibrobot_lerobot.model import PolicyModel
    from ibrobot_lerobot.pipeline import LeRobotSteps

SEED = "seed"
"""Seed of the model's noise, shape (1,)."""
TASK = "task"
"""The prompt in UTF-8, shape (1, L)."""
PREFIX = "prefix"
"""`Frame.prefix`, normalised, shape (1, K, A)."""
DELAY = "delay_steps"


class LeRobotPolicy(Policy):
    """Runs a LeRobot checkpoint with its saved processors.

    Standard processor steps (rename, batch, device, normalise, unnormalise) run in NumPy; if there are others, LeRobot
    runs the processor. With standard steps, camera images are not normalised before `infer`, which reduces requests to
    a quarter of their size.

    Args:
        options: checkpoint, device and precision.
        ctx: provides the log, the robot's type and the seed.

    Raises:
        PolicyError: if the folder is not a checkpoint, or LeRobot is needed but not installed.
    """

    def __init__(self, options: LeRobotPolicyOptions, ctx: Context) -> None:
        self._options = options
        self._ctx = ctx
        self._checkpoint = checkpoint = read_checkpoint(options.path, options.base_models)
        self.spec = checkpoint.spec(options.n_action_steps)
        self._pre = read_steps(checkpoint, PREPROCESSOR)
        self._post = read_steps(checkpoint, POSTPROCESSOR)
        others = {PREPROCESSOR: self._pre.others, POSTPROCESSOR: self._post.others}
        if "absolute_actions_processor" in self._post.others:
            raise PolicyError(f"{options.path}: actions relative to the state (use_relative_actions) are not supported")
        self._lerobot: LeRobotSteps | None = None
        if any(others.values()):
            steps = "; ".join(f"{file}: {', '.join(names)}" for file, names in others.items() if names)
            ctx.log.info("%s has steps that only LeRobot runs, so this process loads torch (%s)", options.path, steps)
            with held_back(ctx.log):
                self._lerobot = _import("pipeline").LeRobotSteps(checkpoint)
        for step in self._pre.normalising:
            for key in step.modes.keys() - {ACTION}:
                if constant := step.constant(key):
                    ctx.log.warning(
                        "%s: %s: elements %s never changed in the training data; other values become huge "
                        "for the network",
                        *(options.path, key, ", ".join(map(str, constant))),
                    )
        self._pictures: tuple[str, ...] = () if self._pre.others else _pictures(self.spec)
        """Observations that `infer` normalises."""
        self._model: PolicyModel | None = None
        self._expected: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}
        """Tensors of a request without a prefix: dtypes and shapes, with -1 for any size."""
        self._seed = ctx.seed
        self._weights = self._identity = ""

    @override
    def check_weights(self) -> None:
        check_weights(self._checkpoint)

    @override
    def load(self) -> None:
        self.check_weights()
        self._check_version()
        weights = hash_weights(self._options.path)
        log = self._ctx.log
        with held_back(log):
            model = _import("model").PolicyModel(self._checkpoint, self._options, self._pre, self._pictures, log)
            tensors = self.preprocess(self._typical())
            actions = self.postprocess({ACTION: model.warm_up(tensors)})
        Policy.check_finite(f"{self._options.path}: postprocess of its first run", {ACTION: actions})
        # The length of a text, and the output of LeRobot's own steps for it, are not known in advance.
        self._expected = {
            name: (array.dtype, (-1,) * array.ndim if self._pre.others and name != SEED else array.shape)
            for name, array in tensors.items()
        }
        self._model, self._weights = model, weights
        self._identity = f"lerobot {version('lerobot')}, torch {version('torch')}, {model.place}"

    def _check_version(self) -> None:
        if sentence := untested(installed() or ""):
            if self._options.untested == "refuse":
                raise PolicyError(f"{self._options.path}: {sentence}, and `untested` is refuse")
            self._ctx.log.warning("%s: %s", self._options.path, sentence)

    @override
    def reset(self, seed: int) -> None:
        self._seed = seed

    @override
    def close(self) -> None:
        self._model = None

    @override
    def fingerprint(self) -> str:
        return self._checkpoint.fingerprint()

    @override
    def weights(self) -> str:
        return self._weights

    @override
    def identity(self) -> str:
        """Versions of LeRobot and torch, device and precision; empty before `load`."""
        return self._identity

    @override
    def picture_codec(self, quality: int = 90) -> PictureCodec | None:
        if not self._pictures:
            return None
        from ibrobot_lerobot.jpeg import Jpeg

        return Jpeg(quality)

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        if self.spec.prompt and not frame.prompt:
            raise PolicyError(f"{self._checkpoint.type} needs a prompt that describes the task")
        frames = [*frame.history[-self.spec.history :], frame] if self.spec.history else [frame]
        # Repeat an episode's first frame to fill the history, as in LeRobot.
        frames = [frames[0]] * (self._checkpoint.n_obs_steps - len(frames)) + frames
        each = [self._run_pre(self._batch(one), frame.prompt) for one in frames[:-1]]
        tensors = self._run_pre(self._batch(frames[-1], frame.prefix), frame.prompt)
        for name in tensors.keys() & self._checkpoint.inputs.keys() if each else ():
            tensors[name] = np.stack([*(one[name] for one in each), tensors[name]], axis=1)
        for key in self._pictures:
            tensors[key] = np.stack([one.values[key] for one in frames]) if each else frames[-1].values[key]
        if frame.prefix is not None and self.spec.prefix:
            tensors[PREFIX] = tensors.pop(ACTION)
            tensors[DELAY] = np.array([frame.delay_steps], np.int64)
        if self.spec.prompt:
            tensors[TASK] = np.frombuffer(frame.prompt.encode(), np.uint8)[None]
        tensors[SEED] = _seed(self._seed, frame.stamp_ns)
        return tensors

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return self.infer_batch([tensors])[0]

    @override
    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        if self._model is None:
            raise PolicyError(f"{self._options.path} is not loaded: call load() first")
        for tensors in batch:
            self._check(tensors)
        return list(self._model.predict(batch))

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        self._publish(tensors)
        action = np.asarray(tensors[ACTION])
        if self._lerobot is not None and self._post.others:
            action = self._lerobot.postprocess(action)
        else:
            action = self._post({ACTION: action})[ACTION]
        return action[0, : self.spec.chunk_size].astype(np.float64)

    def _publish(self, tensors: Tensors) -> None:
        """Publish what the network attended to, as `/attention/CAMERA`, white for the most."""
        if (bus := self._ctx.bus) is None or not self._options.attention:
            return
        for name, weights in tensors.items():
            if name.startswith(ATTENTION):
                shares = np.asarray(weights, np.float32)
                height, width = shares.shape
                pixels = (255 * shares / max(float(shares.max()), 1e-12)).astype(np.uint8).ravel()
                shown = Image(Header(self._ctx.clock.now_ns()), height, width, "mono8", width, pixels)
                bus.publish(f"/attention/{name.rpartition('.')[2]}", shown)

    def _check(self, tensors: Tensors) -> None:
        """Check that a request, which may be from an untrusted client, has the tensors that `preprocess` makes."""
        expected = dict(self._expected)
        if self.spec.prompt:
            expected[TASK] = (np.dtype(np.uint8), (1, -1))
        if self.spec.prefix and tensors.keys() & {PREFIX, DELAY}:
            expected[PREFIX] = (np.dtype(np.float32), (1, -1, self._checkpoint.action_size))
            expected[DELAY] = (np.dtype(np.int64), (1,))
        self.check_tensors(tensors, expected, others=bool(self._pre.others))
        if PREFIX in expected:
            delay, length, most = int(tensors[DELAY][0]), tensors[PREFIX].shape[1], self._checkpoint.chunk_size
            if not 0 <= delay <= length <= most:
                raise PolicyError(
                    f"the request's tensors: {DELAY} {delay} and a {PREFIX} of {length}: 0 <= {DELAY} <= {length} <= "
                    f"{most} must hold"
                )

    def _batch(self, frame: Frame, prefix: NDArray[Any] | None = None) -> dict[str, NDArray[Any]]:
        """A batch of one in LeRobot's layout: images (1, C, H, W) from 0 to 1."""
        batch: dict[str, NDArray[Any]] = {}
        for key, shape in self.spec.observations.items():
            value = frame.observation(key, shape)
            if len(shape) == 3:
                if key in self._pictures:
                    continue
                value = np.ascontiguousarray(value.transpose(2, 0, 1)).astype(np.float32) / np.float32(255)
            batch[key] = value.astype(np.float32)[None]
        if prefix is not None and self.spec.prefix:
            batch[ACTION] = prefix.astype(np.float32)[None]
        return batch

    def _run_pre(self, batch: Mapping[str, NDArray[Any]], prompt: str) -> dict[str, NDArray[Any]]:
        if self._lerobot is not None and self._pre.others:
            return self._lerobot.preprocess(batch, prompt, self._ctx.robot.robot_type)
        return self._pre(batch)

    def _typical(self) -> Frame:
        """A frame from the middle of the training data, with black images, for the first run."""
        values: dict[str, NDArray[np.generic]] = {
            key: np.zeros(shape, np.uint8 if len(shape) == 3 else np.float32)
            for key, shape in self.spec.observations.items()
        }
        names = self._checkpoint.names
        for step in self._pre.normalising:
            for key, shape in self.spec.observations.items():
                if len(shape) < 3 and names[key] in step.modes:
                    middle = np.ravel(step.middle(names[key]))[: math.prod(shape)]  # without padding
                    values[key] = middle.reshape(shape).astype(np.float32)
        return Frame(0, values, prompt="warm up" if self.spec.prompt else "")


def _pictures(spec: PolicySpec) -> tuple[str, ...]:
    return tuple(key for key, shape in spec.observations.items() if len(shape) == 3)


def _seed(episode: int, stamp_ns: int) -> NDArray[np.int64]:
    """The seed of a request, derived from the episode's seed and the tick."""
    words = np.random.SeedSequence([episode % 2**64, stamp_ns % 2**64]).generate_state(1, np.uint64)
    return (words >> np.uint64(1)).astype(np.int64)


def _import(name: str) -> Any:
    """Import a module of this plugin that needs torch."""
    # Spinning threads slow torch down several times if they share cores with other work. OpenMP reads this variable
    # when torch loads it.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        return import_module(f"ibrobot_lerobot.{name}")
    except Exception as error:  # of whatever LeRobot imports
        if find_spec("lerobot") is None:
            raise PolicyError(f"LeRobot policies need LeRobot ({error}); install it with: {INSTALL}") from error
        raise PolicyError(f"LeRobot is installed, but cannot be imported: {cause(error)}") from error
