"""Reads a checkpoint without torch: its configuration, its processors, and the origin of its training data."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import attrs
from safetensors import SafetensorError, safe_open

from ibrobot_core.api import Contract, ContractError, PolicyError, PolicySpec
from ibrobot_lerobot import layout
from ibrobot_lerobot.policy_types import OTHER, POLICY_TYPES, check_type
from ibrobot_lerobot.untrusted import (
    MAX_ACTIONS,
    MAX_HISTORY,
    check_models,
    check_steps,
    check_values,
    own_file,
    read_json,
    shape,
    statistics_file,
    whole,
)

PREPROCESSOR = "policy_preprocessor.json"
POSTPROCESSOR = "policy_postprocessor.json"
WEIGHTS = "model.safetensors"
ACTION = "action"
NOTE = "ibrobot.json"
"""A copy of the dataset's `meta/ibrobot.json`, beside the checkpoint."""
TRAINING = "train_config.json"
RENAME = "rename_observations_processor"

_CHUNK_SIZES = ("chunk_size", "action_chunk_size", "action_horizon", "n_action_steps")
_SHORTER_CHUNKS = frozenset({"diffusion", "multi_task_dit"})
"""Policies that predict a horizon and return `n_action_steps` of it."""
_ACTION_HEADS = {"act": "model.action_head.weight", "diffusion": "diffusion.unet.final_conv.1.weight"}
"""Type -> the tensor of weights whose first dimension is the size of an action."""
_EMPTY_CAMERA = "observation.images.empty_camera_"
"""Placeholder for a camera of a pretrained model that the robot lacks; the model fills it in."""


@attrs.frozen
class Checkpoint:
    """The contents of a checkpoint's files, without the weights."""

    path: Path
    type: str
    """LeRobot's name of the policy type, e.g. `act`."""
    config: Mapping[str, Any]
    inputs: Mapping[str, tuple[str, tuple[int, ...]]]
    """Feature name in the policy -> type (STATE, ENV, VISUAL) and shape of the observation; images are (H, W, C)."""
    action_size: int
    chunk_size: int
    n_obs_steps: int
    """Number of ticks of observations that the policy uses."""
    processors: Mapping[str, Mapping[str, Any]]
    """File -> its JSON."""
    trained_on: Mapping[str, Any]
    """The dataset's `meta/ibrobot.json`; empty if unknown."""
    trained_on_path: Path | None

    @property
    def names(self) -> dict[str, str]:
        """Key in the contract -> feature name in the policy."""
        renamed: dict[str, str] = {}
        for step in self.processors[PREPROCESSOR]["steps"]:
            if step.get("registry_name") == RENAME:
                renamed |= rename_map(self.path / PREPROCESSOR, step)
        back = {inside: outside for outside, inside in renamed.items()}
        return {back.get(name, name): name for name in self.inputs}

    def spec(self, n_action_steps: int | None) -> PolicySpec:
        """Inputs and outputs of the policy, with chunks of at most `n_action_steps`."""
        contract, norm_mode = self._trained()
        known = POLICY_TYPES.get(self.type, OTHER)
        return PolicySpec(
            observations={key: self.inputs[name][1] for key, name in self.names.items()},
            actions=contract.action_names if contract is not None else None,
            action_size=self.action_size,
            chunk_size=min(self.chunk_size, n_action_steps or self.chunk_size),
            rate_hz=contract.rate_hz if contract is not None else None,
            prompt=known.prompt,
            prefix=known.prefix,
            history=self.n_obs_steps - 1,
            contract=contract.canonical() if contract is not None else None,
            norm_mode=norm_mode,
        )

    def _trained(self) -> tuple[Contract | None, str | None]:
        if not self.trained_on:
            return None, None
        try:
            contract = Contract.from_canonical(self.trained_on["contract"])
            return contract, str(self.trained_on["conversion"]["norm_mode"])
        except (KeyError, TypeError, ValueError, AttributeError, ContractError) as error:
            raise PolicyError(
                f"{self.trained_on_path}: is not a meta/{NOTE} file of `ibrobot convert`: {error!r}"
            ) from None

    def fingerprint(self) -> str:
        """SHA-256, the first 32 hexadecimal digits, of configuration, processors and statistics."""
        digest = hashlib.sha256()
        for name in ("config.json", *self.processors):
            digest.update(f"{name}\0".encode() + (self.path / name).read_bytes())
        for each in self.processors.values():
            for step in each["steps"]:
                if "state_file" in step:
                    file = statistics_file(self.path, step["state_file"])
                    digest.update(f"{file.name}\0".encode() + file.read_bytes())
        return digest.hexdigest()[:32]


def read_checkpoint(path: Path, base_models: Collection[str] = ()) -> Checkpoint:
    """Read the folder at `path`.

    Args:
        path: the folder.
        base_models: models and folders that LeRobot may load for it, in addition to those in LeRobot's configurations.

    Raises:
        PolicyError: if it is not a checkpoint of LeRobot 0.6, is incomplete, or would run foreign code or read files
            outside its folder.
    """
    if not (path / "config.json").exists():
        inner = [each for each in ("pretrained_model", "checkpoints/last/pretrained_model") if (path / each).is_dir()]
        hint = f"did you mean {path / inner[0]}?" if inner else "lerobot-train writes it to …/pretrained_model"
        raise PolicyError(f"{path} is not a folder with a checkpoint: it has no config.json; {hint}")
    file = path / "config.json"
    config = read_json(path, file.name)
    if config.get("use_peft"):
        raise PolicyError(f"{path} contains only an adapter (use_peft); merge it into its base model")
    kind = check_type(file, config.get("type"))
    check_values(file, config)
    processors = {name: _processor(path, name) for name in (PREPROCESSOR, POSTPROCESSOR)}
    check_models(path, {file.name: config, **processors}, base_models)
    try:
        inputs = {
            name: (feature["type"], _shape(file, name, feature))
            for name, feature in config["input_features"].items()
            if feature["type"] in ("STATE", "ENV", "VISUAL") and not name.startswith(_EMPTY_CAMERA)
        }
        [action_size] = shape(file, ACTION, config["output_features"][ACTION]["shape"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PolicyError(f"{file}: is not a policy configuration of LeRobot 0.6: {error!r}") from None
    sizes = [size for size in _CHUNK_SIZES if config.get(size) is not None]
    if not sizes:
        raise PolicyError(
            f"{file}: policies of type {kind!r} are not supported: none of {', '.join(_CHUNK_SIZES)} gives the length "
            "of their action chunks"
        )
    size = "n_action_steps" if kind in _SHORTER_CHUNKS else sizes[0]
    chunk_size = whole(file, size, config.get(size), MAX_ACTIONS)
    n_obs_steps = whole(file, "n_obs_steps", config.get("n_obs_steps", 1), MAX_HISTORY)
    note = _note_path(path)
    trained_on = read_json(note.parent, note.name) if note is not None else {}
    return Checkpoint(path, kind, config, inputs, action_size, chunk_size, n_obs_steps, processors, trained_on, note)


def rename_map(path: Path, step: Mapping[str, Any]) -> dict[str, str]:
    """Robot's -> policy's names of observations, from a step `RENAME` of the processor at `path`.

    Raises:
        PolicyError: if it is not a map of names.
    """
    names = step.get("config", {}).get("rename_map", {})
    if not isinstance(names, dict) or not all(isinstance(name, str) for name in names.values()):
        raise PolicyError(f"{path}: rename_map is {names!r}, must map names to names")
    return names


def check_weights(checkpoint: Checkpoint) -> None:
    """Check that the checkpoint has weights in a safe format whose action size matches the configuration.

    Raises:
        PolicyError: if the weights are missing, in a format that can contain code, or for another number of joints.
    """
    path = checkpoint.path
    if (path / WEIGHTS).exists():
        file, head = own_file(path, WEIGHTS), _ACTION_HEADS.get(checkpoint.type, "")
        size, memory = file.stat().st_size, os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if size > memory:
            raise PolicyError(f"{file}: has {size / 1e9:.0f} GB, more than this machine's memory")
        try:
            with safe_open(file, framework="numpy") as weights:  # reads only the header
                size = weights.get_slice(head).get_shape()[0] if head in weights.keys() else checkpoint.action_size  # noqa: SIM118
        except (OSError, SafetensorError) as error:
            raise PolicyError(f"{file}: cannot be read: {error}") from None
        if size != checkpoint.action_size:
            raise PolicyError(f"{file}: actions have {size} values, but config.json says {checkpoint.action_size}")
        return
    others = sorted(each.name for each in path.iterdir() if each.suffix in (".bin", ".pt", ".pth", ".ckpt", ".pkl"))
    if others:
        raise PolicyError(
            f"{path} has its weights in {others[0]}, which can run any code when it is loaded; "
            f"ask its author for {WEIGHTS}"
        )
    raise PolicyError(
        f"{path} has no weights: {WEIGHTS} is missing (a robot with distributed inference does not need it)"
    )


def hash_weights(path: Path) -> str:
    """SHA-256, the first 32 hexadecimal digits, of the weights in the folder at `path`."""
    with (path / WEIGHTS).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:32]


def _note_path(path: Path) -> Path | None:
    """The file that describes the training data, beside the checkpoint or in the dataset; None if there is none."""
    if (path / NOTE).is_file():
        return path / NOTE
    if not (path / TRAINING).is_file():
        return None
    dataset = read_json(path, TRAINING).get("dataset")
    root = dataset.get("root") if isinstance(dataset, dict) else None
    own = Path(root) / layout.OWN if isinstance(root, str) and "\0" not in root else None
    return own if own is not None and own.is_file() else None


def _shape(file: Path, name: str, feature: Mapping[str, Any]) -> tuple[int, ...]:
    sizes = shape(file, name, feature["shape"])
    return (*sizes[1:], sizes[0]) if feature["type"] == "VISUAL" else sizes


def _processor(folder: Path, name: str) -> dict[str, Any]:
    if not (folder / name).exists():
        raise PolicyError(
            f"{folder} has no {name}: it is from before LeRobot 0.4; "
            "`python -m lerobot.processor.migrate_policy_normalization` updates it"
        )
    document = read_json(folder, name)
    check_steps(folder / name, document)
    check_values(folder / name, document)
    return document
