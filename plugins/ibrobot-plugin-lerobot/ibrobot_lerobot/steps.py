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
from ibrobot_lerobot.checkpoint import ACTION, RENAME, Checkpoint, rename_map
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
    """Key -> mode, only for keys with statistics."""
    statistics: Mapping[str, tuple[Any, Any]]
    """Key -> mean and divisor, or lower end and length of the range; float32."""
    inverse: bool

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Normalise the values that have statistics; others are unchanged."""
        return {key: self._apply(key, value) if key in self.modes else value for key, value in batch.items()}

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
        PolicyError: if its statistics cannot be read.
    """
    steps: list[Step] = []
    others = []
    for entry in checkpoint.processors[file]["steps"]:
        name, config = str(entry.get("registry_name") or entry["class"]), entry.get("config", {})
        if name == RENAME:
            steps.append(Rename(rename_map(checkpoint.path / file, entry)))
        elif name in ("normalizer_processor", "unnormalizer_processor"):
            try:
                steps.append(_normalise(checkpoint.path / file, entry, inverse=name.startswith("un")))
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise PolicyError(f"{checkpoint.path / file}: step {name!r} cannot be read: {error!r}") from None
        elif not _does_nothing(name, config):
            others.append(name)
    return Steps(steps, others)


def _does_nothing(name: str, config: Mapping[str, Any]) -> bool:
    """Whether a step changes no values: there is only one device, and the batch already exists."""
    if name == "device_processor":
        return config.get("float_dtype") in (None, "float32", "float")
    return name == "to_batch_processor" or (name == "absolute_actions_processor" and not config.get("enabled"))


def _normalise(path: Path, entry: Mapping[str, Any], *, inverse: bool) -> Normalise:
    config, flat = entry["config"], {}
    if "state_file" in entry:
        state = statistics_file(path.parent, entry["state_file"])
        try:
            flat = load_file(state)
        except (OSError, SafetensorError) as error:
            raise PolicyError(f"{state}: cannot be read: {error}") from None
    only, eps = config.get("normalize_observation_keys"), np.float32(config.get("eps", 1e-8))
    modes, statistics = {}, {}
    for name, feature in config["features"].items():
        kind = feature["type"]
        mode = config["norm_map"].get(kind, "IDENTITY")
        key = ACTION if kind == "ACTION" else name
        if mode == "IDENTITY" or not any(each.rpartition(".")[0] == key for each in flat):
            continue
        if only is not None and kind != "ACTION" and key not in only:
            continue
        if mode not in _STATISTICS:
            raise PolicyError(f"{path}: {key} is normalised by {mode!r}; LeRobot 0.6 has: {', '.join(_STATISTICS)}")
        names = [f"{key}.{statistic}" for statistic in _STATISTICS[mode]]
        if missing := [each for each in names if each not in flat]:
            raise PolicyError(f"{path.parent / entry['state_file']}: {mode} needs {missing[0]}, which is missing")
        _check_sizes(path.parent / entry["state_file"], {each: flat[each] for each in names}, kind, feature["shape"])
        low, high = (_of_channels(flat[each], kind).astype(np.float32) for each in names)
        if mode != "MEAN_STD":
            high = np.where(high == low, eps, high - low)
        elif not inverse:
            high = high + eps
        modes[key], statistics[key] = mode, (low, high)
    return Normalise(modes, statistics, inverse)


def _check_sizes(file: Path, statistics: Mapping[str, Array], kind: str, shape: Sequence[int]) -> None:
    """Check that statistics have one value per element of a feature, or per channel of an image."""
    wanted = {math.prod(shape), *shape[:1]} if kind == "VISUAL" else {math.prod(shape)}
    for name, statistic in statistics.items():
        if statistic.size not in wanted:
            raise PolicyError(f"{file}: {name} has shape {statistic.shape}, its feature {tuple(shape)}")


def _of_channels(statistic: Array, kind: str) -> Array:
    """A camera's per-channel statistic in a shape that broadcasts with (C, H, W)."""
    return statistic.reshape(-1, 1, 1) if kind == "VISUAL" and statistic.ndim == 1 else statistic
