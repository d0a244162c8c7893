"""Policy `onnx`: exported graphs on ONNX Runtime, in three pure steps."""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Context, Frame, Policy, PolicyError, PolicySpec, Tensors
from ibrobot_onnx.manifest import NOISE, Manifest, Noise, read_manifest, stacked_shape
from ibrobot_onnx.options import PROVIDERS, OnnxPolicyOptions

ACTION = "action"
SEED = "seed"
"""Seed of a request's noise, shape (2,): the episode's seed and the tick."""
_FIRST_S = 60.0
"""Longest time that a first run may take [s]; a policy that drives a robot answers in a second."""
_LATER_S = 20.0
"""Longest time per later request [s], below the time after which a server counts its model as hanging."""
_SAMPLE, _TIME, _CONDITION = "sample", "time", "condition"
"""Inputs of the graph of a denoising step; the last one is the output of the graph that encodes observations."""


class OnnxPolicy(Policy):
    """Runs the graphs that `ibrobot export` wrote.

    The graphs normalise observations; the actions are unnormalised here. A policy that draws noise draws it with
    NumPy, from the seed in the request.

    Args:
        options: folder, provider and threads.
        ctx: provides the log and the seed.

    Raises:
        PolicyError: if the folder has no valid manifest.
    """

    def __init__(self, options: OnnxPolicyOptions, ctx: Context) -> None:
        self._options, self._log = options, ctx.log
        self._manifest = manifest = read_manifest(options.path)
        self.spec = _spec(manifest, options.n_action_steps)
        self._expected = {key: (_dtype(key, manifest), stacked_shape(manifest, key)) for key in manifest.observations}
        """Tensors of a request: dtypes and shapes."""
        if manifest.noise is not None:
            self._expected[SEED] = (np.dtype(np.uint64), (2,))
        self._sessions: list[Any] = []
        self._seed = ctx.seed
        self._weights = self._identity = ""

    @override
    def check_weights(self) -> None:
        for name in self._manifest.graphs:
            path = self._options.path / name
            if not path.is_file():
                raise PolicyError(
                    f"{path}: is missing; copy it from the folder of `ibrobot export` (a robot with distributed "
                    "inference does not need it)"
                )
            size, memory = path.stat().st_size, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
            if size > memory:
                raise PolicyError(f"{path}: has {size / 1e9:.0f} GB, more than this machine's memory")

    @override
    def load(self) -> None:
        self.check_weights()
        digest, sessions = hashlib.sha256(), []
        for name in self._manifest.graphs:
            graph = (self._options.path / name).read_bytes()
            digest.update(graph)
            sessions.append(_session(self._options, self._options.path / name, graph))
        zeros = {key: np.zeros(shape, dtype) for key, (dtype, shape) in self._expected.items()}
        [chunk] = self._run(sessions, [zeros], _FIRST_S, "its first run")
        manifest = self._manifest
        if chunk.dtype.kind not in "fiu":
            kind = "text" if chunk.dtype.kind in "OSU" else str(chunk.dtype)
            raise PolicyError(f"{self._options.path}: the graph returns {kind}; actions are numbers")
        least = manifest.first + manifest.chunk_size
        if chunk.ndim != 2 or chunk.shape[0] < least or chunk.shape[1] != manifest.action_size:
            raise PolicyError(
                f"{self._options.path}: the graph returns actions of shape {chunk.shape}; {manifest.path.name} states "
                f"{manifest.action_size} values in at least {least} actions"
            )
        Policy.check_finite(f"{self._options.path}: infer of its first run", {ACTION: chunk})
        with np.errstate(all="ignore"):  # the check names it
            actions = self.postprocess({ACTION: chunk})
        Policy.check_finite(f"{self._options.path}: postprocess of its first run", {ACTION: actions})
        self._sessions, self._weights = sessions, digest.hexdigest()[:32]
        self._identity = f"onnxruntime {version('onnxruntime')}, {sessions[0].get_providers()[0]}"
        self._log.info("%s on %s", manifest.type, sessions[0].get_providers()[0])

    @override
    def reset(self, seed: int) -> None:
        self._seed = seed

    @override
    def close(self) -> None:
        self._sessions = []

    @override
    def fingerprint(self) -> str:
        return hashlib.sha256(json.dumps(self._manifest.content, sort_keys=True).encode()).hexdigest()[:32]

    @override
    def weights(self) -> str:
        return self._weights

    @override
    def identity(self) -> str:
        """Version of ONNX Runtime, and the provider; empty before `load`."""
        return self._identity

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        history = self.spec.history
        frames = [*frame.history[-history:], frame] if history else [frame]
        # Repeat an episode's first frame to fill the history, as in training.
        frames = [frames[0]] * (history + 1 - len(frames)) + frames
        tensors: dict[str, NDArray[Any]] = {}
        for key, shape in self.spec.observations.items():
            values = [each.observation(key, shape).astype(_dtype(key, self._manifest)) for each in frames]
            tensors[key] = np.stack(values) if history else values[0]
        if self._manifest.noise is not None:
            tensors[SEED] = np.array([self._seed % 2**64, frame.stamp_ns % 2**64], np.uint64)
        return tensors

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return self.infer_batch([tensors])[0]

    @override
    def infer_batch(self, batch: Sequence[Tensors]) -> list[Tensors]:
        if not self._sessions:
            raise PolicyError(f"{self._options.path} is not loaded: call load() first")
        for tensors in batch:
            self.check_tensors(tensors, self._expected)
        return [{ACTION: actions} for actions in self._run(self._sessions, batch, _LATER_S * len(batch), "a request")]

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        manifest = self._manifest
        first = manifest.first
        chunk = np.asarray(tensors[ACTION], np.float64)[first : first + self.spec.chunk_size]
        return chunk * manifest.scale + manifest.offset

    def _run(self, sessions: Sequence[Any], batch: Sequence[Tensors], limit_s: float, what: str) -> list[NDArray[Any]]:
        """Outputs of the network, each of shape (N, A), before they are unnormalised.

        Args:
            sessions: those of the graphs.
            batch: the requests.
            limit_s: longest time that it may take [s].
            what: the run, for the error.

        Raises:
            PolicyError: if ONNX Runtime fails, or it takes too long, e.g. in a loop of the graph.
        """
        import onnxruntime

        settings = onnxruntime.RunOptions()
        timer = threading.Timer(limit_s, setattr, (settings, "terminate", True))
        timer.start()
        try:
            return self._compute(sessions, batch, settings)
        except PolicyError as error:
            if settings.terminate:
                raise PolicyError(
                    f"{self._options.path}: {what} takes more than {limit_s:g} s; such a graph cannot drive a robot"
                ) from error
            raise
        finally:
            timer.cancel()
            timer.join()

    def _compute(self, sessions: Sequence[Any], batch: Sequence[Tensors], settings: Any) -> list[NDArray[Any]]:
        """The outputs, with ONNX Runtime's options of a run."""
        manifest = self._manifest
        inputs = {key: np.stack([tensors[key] for tensors in batch]) for key in manifest.observations}
        noise = manifest.noise
        if noise is None:
            return list(_outputs(sessions[0], inputs, settings))
        draws = [np.random.default_rng(np.asarray(tensors[SEED])) for tensors in batch]
        if not manifest.steps:
            return list(_outputs(sessions[0], {**inputs, NOISE: _drawn(noise, draws)}, settings))
        encode, denoise = sessions
        condition = _outputs(encode, inputs, settings)
        x = _drawn(noise, draws)
        for step in manifest.steps:
            times = np.full(len(batch), step.time, np.int64)
            y = _outputs(denoise, {_SAMPLE: x, _TIME: times, _CONDITION: condition}, settings)
            estimate = step.estimate_x * x + step.estimate_y * y
            if manifest.clip is not None:
                estimate = estimate.clip(-manifest.clip, manifest.clip)
            x = (step.next_e * estimate + step.next_x * x + step.next_y * y).astype(np.float32)
            if step.next_z:
                x += np.float32(step.next_z) * _drawn(noise, draws)
        return list(x)


def _spec(manifest: Manifest, n_action_steps: int | None) -> PolicySpec:
    contract = manifest.contract
    return PolicySpec(
        observations=manifest.observations,
        actions=contract.action_names if contract is not None else None,
        action_size=manifest.action_size,
        chunk_size=min(manifest.chunk_size, n_action_steps or manifest.chunk_size),
        rate_hz=contract.rate_hz if contract is not None else None,
        history=manifest.history,
        contract=contract.canonical() if contract is not None else None,
        norm_mode=manifest.norm_mode,
    )


def _dtype(key: str, manifest: Manifest) -> np.dtype[Any]:
    return np.dtype(np.uint8 if len(manifest.observations[key]) == 3 else np.float32)


def _drawn(noise: Noise, draws: Sequence[np.random.Generator]) -> NDArray[np.float32]:
    """Noise for each request of a batch."""
    if noise.distribution == "normal":
        return np.stack([draw.standard_normal(noise.shape, np.float32) for draw in draws])
    return np.stack([draw.random(noise.shape, np.float32) for draw in draws])


def _session(options: OnnxPolicyOptions, path: Path, graph: bytes) -> Any:
    """A session of ONNX Runtime for a graph, on the provider of the options and no other.

    Raises:
        PolicyError: if the provider is not available, or the graph is not valid.
    """
    # It would send its use of this machine to its makers.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    wanted = PROVIDERS[options.provider]
    available = onnxruntime.get_available_providers()
    if wanted not in available:
        names = [name for name, theirs in PROVIDERS.items() if theirs in available]
        raise PolicyError(
            f"provider {options.provider!r}: the installed ONNX Runtime {onnxruntime.__version__} has only "
            f"{', '.join(names)}; install a build that has it, e.g. onnxruntime-gpu or onnxruntime-openvino, in place "
            "of onnxruntime"
        )
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = options.threads or max(1, _cores() - 1)
    settings.inter_op_num_threads = 1
    settings.log_severity_level = 3
    # Threads that spin between requests would take time from the control loop.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(graph, settings, providers=[wanted])
    except Exception as error:  # its exceptions have no common base but Exception
        raise PolicyError(f"{path}: ONNX Runtime cannot load it: {_first_line(error)}") from error
    if session.get_providers()[0] != wanted:
        raise PolicyError(f"provider {options.provider!r}: ONNX Runtime could not start it and would use the CPU")
    return session


def _outputs(session: Any, inputs: Mapping[str, NDArray[Any]], settings: Any) -> NDArray[Any]:
    """The only output of a graph, for a batch."""
    try:
        outputs = session.run(None, dict(inputs), settings)
    except Exception as error:  # as above
        raise PolicyError(f"ONNX Runtime: {_first_line(error)}") from error
    if len(outputs) != 1 or not isinstance(outputs[0], np.ndarray):
        raise PolicyError(f"a graph must have one output, has {len(outputs)}")
    return outputs[0]


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0] or type(error).__name__


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
