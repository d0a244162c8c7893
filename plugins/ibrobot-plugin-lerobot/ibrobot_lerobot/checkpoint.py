"""A checkpoint's folder, read without torch: its configuration, its processors, and what it was trained on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ContractError, PolicyError
from ibrobot_core.interfaces import PolicySpec
from ibrobot_lerobot import layout

PREPROCESSOR = "policy_preprocessor.json"
POSTPROCESSOR = "policy_postprocessor.json"
WEIGHTS = "model.safetensors"
ACTION = "action"
NOTE = "ibrobot.json"
"""A copy of the dataset's `meta/ibrobot.json`, beside the checkpoint."""
RENAME = "rename_observations_processor"

_WITHOUT_PROMPT = frozenset({"act", "diffusion", "vqbet", "tdmpc", "gaussian_actor"})
_REAL_TIME_CHUNKING = frozenset({"evo1", "groot", "molmoact2", "pi0", "pi05", "smolvla"})
_CHUNK_SIZES = ("chunk_size", "action_chunk_size", "action_horizon", "n_action_steps")
_SHORTER_CHUNKS = frozenset({"diffusion", "multi_task_dit"})
"""They predict a horizon, and give `n_action_steps` of it."""
_EMPTY_CAMERA = "observation.images.empty_camera_"
"""Stands for a camera that a pretrained model had and the robot has not; the model fills it in."""


@attrs.frozen
class Checkpoint:
    """What the files say, but for the weights."""

    path: Path
    type: str
    """LeRobot's name of the kind of policy, e.g. `act`."""
    config: Mapping[str, Any]
    inputs: Mapping[str, tuple[str, tuple[int, ...]]]
    """Names within the policy -> kind (STATE, ENV, VISUAL), and shape of the observation: images (H, W, C)."""
    action_size: int
    chunk_size: int
    processors: Mapping[str, Mapping[str, Any]]
    """File -> its JSON."""
    trained_on: Mapping[str, Any]
    """The dataset's `meta/ibrobot.json`; empty where it is not known."""
    trained_on_path: Path | None

    @property
    def n_obs_steps(self) -> int:
        """Ticks of observations that it sees at once."""
        return int(self.config.get("n_obs_steps", 1))

    @property
    def names(self) -> dict[str, str]:
        """The contract's keys -> names within the policy."""
        renamed: dict[str, str] = {}
        for step in self.processors[PREPROCESSOR]["steps"]:
            if step.get("registry_name") == RENAME:
                renamed |= step["config"].get("rename_map", {})
        back = {inside: outside for outside, inside in renamed.items()}
        return {back.get(name, name): name for name in self.inputs}

    def spec(self, n_action_steps: int | None) -> PolicySpec:
        """What it needs and gives, with chunks of at most `n_action_steps`."""
        contract, norm_mode = self._trained()
        return PolicySpec(
            observations={key: self.inputs[name][1] for key, name in self.names.items()},
            actions=contract.action_joints if contract is not None else None,
            action_size=self.action_size,
            chunk_size=min(self.chunk_size, n_action_steps or self.chunk_size),
            rate_hz=contract.rate_hz if contract is not None else None,
            prompt=self.type not in _WITHOUT_PROMPT,
            prefix=self.type in _REAL_TIME_CHUNKING,
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
        except (KeyError, TypeError, ContractError) as error:
            raise PolicyError(f"{self.trained_on_path}: is no meta/{NOTE} of `ibrobot convert`'s: {error!r}") from None

    def fingerprint(self) -> str:
        """SHA-256, the first 32 hexadecimal digits, of configuration, processors and statistics."""
        digest = hashlib.sha256()
        states = [
            step["state_file"] for each in self.processors.values() for step in each["steps"] if "state_file" in step
        ]
        for name in ("config.json", PREPROCESSOR, POSTPROCESSOR, *states):
            digest.update(f"{name}\0".encode() + (self.path / name).read_bytes())
        return digest.hexdigest()[:32]


def read_checkpoint(path: Path) -> Checkpoint:
    """Read the folder at `path`.

    Raises:
        PolicyError: when it is no checkpoint of LeRobot 0.6's, or one that needs something beside it.
    """
    if not (path / "config.json").is_file():
        inner = [each for each in ("pretrained_model", "checkpoints/last/pretrained_model") if (path / each).is_dir()]
        hint = f"did you mean {path / inner[0]}?" if inner else "lerobot-train writes it to …/pretrained_model"
        raise PolicyError(f"{path} is no folder with a checkpoint: it has no config.json; {hint}")
    config = _json(path / "config.json")
    if config.get("use_peft"):
        raise PolicyError(f"{path} has an adapter only (use_peft); merge it into the model that it adapts")
    processors = {name: _processor(path / name) for name in (PREPROCESSOR, POSTPROCESSOR)}
    try:
        inputs = {
            name: (feature["type"], _shape(feature))
            for name, feature in config["input_features"].items()
            if feature["type"] in ("STATE", "ENV", "VISUAL") and not name.startswith(_EMPTY_CAMERA)
        }
        [action_size] = config["output_features"][ACTION]["shape"]
        sizes = ("n_action_steps",) if config["type"] in _SHORTER_CHUNKS else _CHUNK_SIZES
        chunk_size = next(int(config[size]) for size in sizes if config.get(size) is not None)
        kind = str(config["type"])
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as error:
        raise PolicyError(f"{path / 'config.json'}: is no policy's configuration of LeRobot 0.6: {error!r}") from None
    note = _note_path(path)
    trained_on = _json(note) if note is not None else {}
    return Checkpoint(path, kind, config, inputs, int(action_size), chunk_size, processors, trained_on, note)


def check_weights(path: Path) -> None:
    """See that there are weights, and that reading them runs no code.

    Raises:
        PolicyError: when there are none, or in a format that carries code.
    """
    if (path / WEIGHTS).is_file():
        return
    others = sorted(each.name for each in path.iterdir() if each.suffix in (".bin", ".pt", ".pth", ".ckpt", ".pkl"))
    if others:
        raise PolicyError(
            f"{path} has its weights in {others[0]}, which can run any code when it is read; "
            f"ask who made it for {WEIGHTS}"
        )
    raise PolicyError(
        f"{path} has no weights: {WEIGHTS} is missing; on the robot of a distributed setup none is needed"
    )


def _note_path(path: Path) -> Path | None:
    """What tells of the training set: the note beside the checkpoint, else the dataset, where it still lies here."""
    if (path / NOTE).is_file():
        return path / NOTE
    train = path / "train_config.json"
    root = (_json(train).get("dataset") or {}).get("root") if train.is_file() else None
    own = Path(root) / layout.OWN if root else None
    return own if own is not None and own.is_file() else None


def _shape(feature: Mapping[str, Any]) -> tuple[int, ...]:
    shape = tuple(int(n) for n in feature["shape"])
    return (*shape[1:], shape[0]) if feature["type"] == "VISUAL" else shape


def _processor(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise PolicyError(
            f"{path.parent} has no {path.name}: a checkpoint from before LeRobot 0.4, which "
            "`python -m lerobot.processor.migrate_policy_normalization` brings up to date"
        )
    document = _json(path)
    if not isinstance(document.get("steps"), list):
        raise PolicyError(f"{path}: has no list of steps")
    return document


def _json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: cannot be read: {error}") from None
    if not isinstance(document, dict):
        raise PolicyError(f"{path}: must be a JSON object, not {type(document).__name__}")
    return document
