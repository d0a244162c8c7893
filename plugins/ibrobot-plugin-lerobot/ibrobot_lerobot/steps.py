"""LeRobot's standard processor steps for arrays of any library: rename, normalise, unnormalise; equal bit by bit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from ibrobot_core.api import PolicyError
from ibrobot_lerobot.checkpoint import ACTION, PREPROCESSOR, RENAME, Checkpoint, rename_map
from ibrobot_lerobot.untrusted import statistics_file

type Array = NDArray[Any]

_SPANS = {"MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"), "QUANTILE10": ("q10", "q90")}
_STATISTICS = {"MEAN_STD": ("mean", "std"), **_SPANS}


@attrs.frozen
class Rename:
    """Renames observations to the policy's names."""

    names: Mapping[str, str]

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """The batch under its new names."""
        return {self.names.get(key, key): value for key, value in batch.items()}


@attrs.frozen(eq=False)
class Normalise:
    """Normalises observations and action, or unnormalises them.

    The operations are those of LeRobot, in the same order and in single precision, so that the results are equal.
    """

    modes: Mapping[str, str]
    """Key -> mode, for what is normalised."""
    statistics: Mapping[str, tuple[Any, Any]]
    """Key -> mean and divisor, or lower end and length of the range; float32."""
    inverse: bool
    eps: float
    """What stands for a range of no width."""

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Normalise the values of `modes`; others are unchanged."""
        return {key: self._apply(key, value) if key in self.modes else value for key, value in batch.items()}

    def middle(self, key: str) -> Any:
        """The mean of a key, or the middle of its range."""
        low, span = self.statistics[key]
        return low if self.modes[key] == "MEAN_STD" else low + span / 2

    def constant(self, key: str) -> list[int]:
        """The elements of a key that never changed in the training data."""
        return np.flatnonzero(np.ravel(self.statistics[key][1]) <= self.eps).tolist()

    def _apply(self, key: str, value: Any) -> Any:
        mode, (low, span) = self.modes[key], self.statistics[key]
        if mode == "MEAN_STD":
            return value * span + low if self.inverse else (value - low) / span
        if not self.inverse:
            return (value - low) * 2.0 / span - 1.0
        return (value + 1.0) / 2.0 * span + low if mode == "MIN_MAX" else (value + 1.0) * span / 2.0 + low


type Step = Rename | Normalise


@attrs.frozen
class Steps:
    """A processor: the steps that run in NumPy, and those that do not."""

    steps: Sequence[Step]
    others: Sequence[str]
    """Non-standard steps, by LeRobot's names; if there are any, LeRobot must run the whole processor."""

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Run all steps in order."""
        result = dict(batch)
        for step in self.steps:
            result = step(result)
        return result

    @property
    def normalising(self) -> list[Normalise]:
        """Its steps that normalise."""
        return [step for step in self.steps if isinstance(step, Normalise)]

    def of(self, convert: Callable[[Array], Any]) -> Steps:
        """The same steps for arrays of another library; `convert` converts the statistics."""

        def converted(step: Step) -> Step:
            if isinstance(step, Rename):
                return step
            statistics = {key: (convert(low), convert(span)) for key, (low, span) in step.statistics.items()}
            return attrs.evolve(step, statistics=statistics)

        return Steps([converted(step) for step in self.steps], self.others)


def read_steps(checkpoint: Checkpoint, file: str) -> Steps:
    """The steps of a processor.

    Args:
        checkpoint: the checkpoint of the processor.
        file: `PREPROCESSOR` or `POSTPROCESSOR`.

    Raises:
        PolicyError: if its statistics cannot be read, or do not cover what is normalised.
    """
    steps: list[Step] = []
    others = []
    for entry in checkpoint.processors[file]["steps"]:
        name, config = str(entry.get("registry_name") or entry["class"]), entry.get("config", {})
        if name == RENAME:
            steps.append(Rename(rename_map(checkpoint.path / file, entry)))
        elif name in ("normalizer_processor", "unnormalizer_processor"):
            try:
                steps.append(_normalise(checkpoint, file, entry, inverse=name.startswith("un")))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise PolicyError(f"{checkpoint.path / file}: step {name!r} cannot be read: {error!r}") from None
        elif not _does_nothing(name, config):
            others.append(name)
    read = Steps(steps, others)
    if not others:  # others may normalise, too
        _check_coverage(checkpoint, file, read)
    return read


def _does_nothing(name: str, config: Mapping[str, Any]) -> bool:
    """Whether a step changes no values: there is only one device, and the batch already exists."""
    if name == "device_processor":
        return config.get("float_dtype") in (None, "float32", "float")
    return name == "to_batch_processor" or (name == "absolute_actions_processor" and not config.get("enabled"))


def _normalise(checkpoint: Checkpoint, file: str, entry: Mapping[str, Any], *, inverse: bool) -> Normalise:
    config, flat, path = entry["config"], {}, checkpoint.path / file
    if "state_file" in entry:
        path = statistics_file(checkpoint.path, entry["state_file"])
        try:
            flat = load_file(path)
        except (OSError, SafetensorError) as error:
            raise PolicyError(f"{path}: cannot be read: {error}") from None
    only, eps = config.get("normalize_observation_keys"), np.float32(config.get("eps", 1e-8))
    modes, statistics = {}, {}
    for key, (kind, shape) in _features(checkpoint, config, inverse=inverse).items():
        mode = config["norm_map"].get(kind, "IDENTITY")
        if mode == "IDENTITY" or (only is not None and kind != "ACTION" and key not in only):
            continue
        if mode not in _STATISTICS:
            raise PolicyError(
                f"{checkpoint.path / file}: {key} is normalised by {mode!r}; LeRobot 0.6 has: {', '.join(_STATISTICS)}"
            )
        available = sorted({name.rpartition(".")[0] for name in flat})
        if key not in available:
            raise PolicyError(
                f"{path}: has no statistics of {key}, which {mode} needs; it has those of: "
                f"{', '.join(available) or 'nothing'}; the policy's features: {', '.join([*checkpoint.inputs, ACTION])}"
            )
        names = [f"{key}.{statistic}" for statistic in _STATISTICS[mode]]
        if missing := [each for each in names if each not in flat]:
            raise PolicyError(f"{path}: {mode} needs {missing[0]}, which is missing")
        _check_statistics(path, mode, {each: flat[each] for each in names}, kind, shape)
        low, high = (_of_channels(flat[each], kind).astype(np.float32) for each in names)
        if mode != "MEAN_STD":
            high = np.where(high == low, eps, high - low)
        elif not inverse:
            high = high + eps
        modes[key], statistics[key] = mode, (low, high)
    return Normalise(modes, statistics, inverse, float(eps))


def _features(
    checkpoint: Checkpoint, config: Mapping[str, Any], *, inverse: bool
) -> dict[str, tuple[str, Sequence[int]]]:
    """Key -> type and shape of the inputs of a step: those of its features that the policy has, and any action."""
    features: dict[str, tuple[str, Sequence[int]]] = {}
    action: Sequence[int] = (checkpoint.action_size,)
    for name, feature in config["features"].items():
        kind, shape = feature["type"], feature["shape"]  # e.g. evo1 pads them
        if kind == "ACTION":
            action = shape
        elif not inverse and name in checkpoint.inputs:
            features[name] = (kind, shape)
    return {**features, ACTION: ("ACTION", action)}


def _check_coverage(checkpoint: Checkpoint, file: str, steps: Steps) -> None:
    """Check that the steps of a processor convert all that `normalization_mapping` of `config.json` covers."""
    mapping = checkpoint.config.get("normalization_mapping") or {}
    kinds = {ACTION: "ACTION"}
    if file == PREPROCESSOR:
        kinds |= {name: kind for name, (kind, _) in checkpoint.inputs.items()}
    converted = {key for step in steps.normalising for key in step.modes}
    for key, kind in kinds.items():
        if mapping.get(kind, "IDENTITY") != "IDENTITY" and key not in converted:
            raise PolicyError(
                f"{checkpoint.path / file}: no step normalises {key}, but normalization_mapping in config.json says "
                f"{kind}: {mapping[kind]}; its steps convert: {', '.join(sorted(converted)) or 'nothing'}"
            )


def _check_statistics(file: Path, mode: str, statistics: Mapping[str, Array], kind: str, shape: Sequence[int]) -> None:
    """Check one value per element of a feature, or per channel of an image: finite, and of a range of some width."""
    wanted = {math.prod(shape), *shape[:1]} if kind == "VISUAL" else {math.prod(shape)}
    for name, statistic in statistics.items():
        if statistic.size not in wanted:
            raise PolicyError(f"{file}: {name} has shape {statistic.shape}, its feature {tuple(shape)}")
        if not np.isfinite(statistic).all():
            raise PolicyError(f"{file}: {name} has values that are not finite")
    (first, low), (last, high) = statistics.items()
    width = np.ravel(high) if mode == "MEAN_STD" else np.ravel(high) - np.ravel(low)
    if width.min() < 0:
        raise PolicyError(f"{file}: {last} is {'negative' if mode == 'MEAN_STD' else f'less than {first}'}")
    if not width.any():
        raise PolicyError(
            f"{file}: {first} and {last} describe no range in any element: the training data did not change, or these "
            "are not their statistics"
        )


def _of_channels(statistic: Array, kind: str) -> Array:
    """A camera's per-channel statistic in a shape that broadcasts with (C, H, W)."""
    return statistic.reshape(-1, 1, 1) if kind == "VISUAL" and statistic.ndim == 1 else statistic
