"""Checks of untrusted checkpoints: which files may be read, and which steps and references are allowed."""

from __future__ import annotations

import json
import re
import stat
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ibrobot_core.api import PolicyError

MAX_ACTIONS = 10_000
"""Maximum number of actions of a chunk."""
MAX_HISTORY = 1_000
"""Maximum number of ticks of observations that a policy uses."""
_MAX_JSON = 8 << 20
_MAX_STATISTICS = 64 << 20
_MAX_DEPTH = 32
_MAX_NUMBER = 10_000_000
"""Upper bound on the dimensions of LeRobot's networks."""
_MAX_ELEMENTS = 1 << 26
"""Maximum number of elements of an observation."""

_STATE_FILE = re.compile(r"\w[\w.-]*\.safetensors", re.ASCII)
_LEROBOTS_CLASS = re.compile(r"lerobot(\.[A-Za-z_]\w*)+", re.ASCII)
_TRAINING = ("optimizer_", "scheduler_")
"""Prefixes of keys whose numbers are not sizes."""
_REMOTE_CODE_STEPS = re.compile(r"action_tokenizer_processor|groot_.*|reward_classifier_processor|.*_encoder")
"""Steps for which LeRobot sets `trust_remote_code`."""
_NAMES_A_MODEL = re.compile(
    r"(.*_)?(tokenizer|vlm_base|vlm_model|base_model|(model|tokenizer|encoder|processor|vlm|base|backbone)_name"
    r"|(name_or|checkpoint|model|pretrained|tokenizer)_path|(model|encoder|assets|hub|tokenizer)_(id|repo)|\w*_dir)"
)
"""Keys that name additional models or files to load."""
_LOOKS_LIKE_A_PATH = re.compile(r"[~.]|.*[/\\]", re.DOTALL)
_NOT_LOADED = frozenset({"pretrained_path", "repo_id", "license", "tags"})
"""Keys that `lerobot-train` only records: nothing is loaded."""
_PROSE = re.compile(r".*(prompt|template|instruction).*")
BASE_MODELS = frozenset(
    {
        "HuggingFaceTB/SmolVLM2-500M-Video-Instruct",
        "OpenGVLab/InternVL3-1B-hf",
        "Qwen/Qwen2.5-VL-3B-Instruct",
        "Qwen/Qwen3-VL-2B-Instruct",
        "Wan-AI/Wan2.2-TI2V-5B",
        "Wan-AI/Wan2.2-TI2V-5B-Diffusers",
        "allenai/MolmoAct2",
        "allenai/MolmoAct2-FAST-Tokenizer",
        "facebook/bart-large",
        "facebook/vjepa2-vitl-fpc64-256",
        "google/paligemma-3b-pt-224",
        "google/umt5-xxl",
        "lerobot/fastwam_base",
        "openai/clip-vit-base-patch16",
        "robbyant/lingbot-va-base",
    }
)
"""Models named in LeRobot's own configurations; none of them runs code."""


def read_json(folder: Path, name: str) -> dict[str, Any]:
    """Read a JSON object from a checkpoint's folder.

    Raises:
        PolicyError: if the file is missing, links outside the folder, is not a regular file, is too large or nested
            too deep, or does not contain a JSON object.
    """
    path = own_file(folder, name, _MAX_JSON)
    try:
        document = json.loads(path.read_bytes())
        too_deep = any(len(place) > _MAX_DEPTH for place, _ in _leaves(document))
    except (OSError, ValueError) as error:
        raise PolicyError(f"{path}: cannot be read: {error}") from None
    except RecursionError:
        too_deep = True
    if too_deep:
        raise PolicyError(f"{path}: is nested more than {_MAX_DEPTH} deep")
    if not isinstance(document, dict):
        raise PolicyError(f"{path}: must be a JSON object, not {type(document).__name__}")
    return document


def own_file(folder: Path, name: str, max_size: int | None = None) -> Path:
    """The path of a file in a checkpoint's folder, which may be a link within the Hugging Face cache.

    Args:
        folder: the checkpoint.
        name: name of the file.
        max_size: maximum size [bytes]; None: unlimited.

    Raises:
        PolicyError: if it is not a regular file, links outside the folder, or is too large.
    """
    path, root = folder / name, folder.resolve()
    try:
        real = path.resolve(strict=True)
        status = real.stat()
    except (OSError, RuntimeError) as error:
        raise PolicyError(f"{path}: cannot be read: {error}") from None
    # The Hugging Face cache has MODEL/snapshots/REVISION/config.json -> ../../blobs/HASH.
    blobs = [root.parents[1] / "blobs"] if root.parent.name == "snapshots" else []
    if not any(real.is_relative_to(allowed) for allowed in (root, *blobs)):
        raise PolicyError(f"{path}: links to {real}, outside the checkpoint; replace the link by the file")
    if not stat.S_ISREG(status.st_mode):
        raise PolicyError(f"{path}: is not a regular file")
    if max_size is not None and status.st_size > max_size:
        raise PolicyError(f"{path}: has {status.st_size} bytes, must have at most {max_size}")
    return path


def statistics_file(folder: Path, name: str) -> Path:
    """The path of a processor step's statistics, checked with `own_file`."""
    return own_file(folder, name, _MAX_STATISTICS)


def check_steps(path: Path, document: Mapping[str, Any]) -> None:
    """Check that each step of a processor is LeRobot's, runs no foreign code, and reads only its own files.

    Args:
        path: the processor's file.
        document: its content.

    Raises:
        PolicyError: if a step is not allowed.
    """
    steps = document.get("steps")
    if not isinstance(steps, list):
        raise PolicyError(f"{path}: has no list of steps")
    for entry in steps:
        if not isinstance(entry, dict):
            raise PolicyError(f"{path}: a step is a {type(entry).__name__}, must be an object")
        key = "registry_name" if "registry_name" in entry else "class"
        name = entry.get(key)
        if not isinstance(name, str) or not name:
            raise PolicyError(f"{path}: the {key} of a step is {name!r}, must be the name of a LeRobot step")
        if key == "class" and not _LEROBOTS_CLASS.fullmatch(name):
            raise PolicyError(
                f"{path}: step {name!r} is not a processor step of LeRobot; no other code of a checkpoint is run"
            )
        check_step_name(path, name)
        if not isinstance(entry.get("config", {}), dict):
            raise PolicyError(f"{path}: the config of step {name!r} is a {type(entry['config']).__name__}")
        state = entry.get("state_file", "none.safetensors")
        if not isinstance(state, str) or not _STATE_FILE.fullmatch(state):
            raise PolicyError(f"{path}: state_file {state!r} is not the plain name of a safetensors file beside it")


def check_step_name(path: Path, name: str) -> None:
    """Refuse a registered step for which LeRobot runs foreign code.

    Raises:
        PolicyError: if the step is not allowed.
    """
    if _REMOTE_CODE_STEPS.fullmatch(name):
        raise PolicyError(f"{path}: step {name!r} runs downloaded code; such policies are not supported")


def check_values(path: Path, document: Mapping[str, Any]) -> None:
    """Check every value of a checkpoint's JSON file.

    Args:
        path: the file.
        document: its content.

    Raises:
        PolicyError: if a number is implausibly large, or a value would run foreign code.
    """
    for place, value in _leaves(document):
        key = _key(place)
        where = f"{path}: {'.'.join(map(str, place))}"
        if key == "trust_remote_code" and value:
            raise PolicyError(f"{where}: would run code that comes with a model; such policies are not supported")
        if isinstance(value, int | float) and not key.startswith(_TRAINING) and not abs(value) <= _MAX_NUMBER:
            raise PolicyError(f"{where} is {value}, must be at most {_MAX_NUMBER}")


def check_models(path: Path, documents: Mapping[str, Mapping[str, Any]], base_models: Collection[str]) -> None:
    """Check that LeRobot loads no model or file besides the checkpoint that the user does not trust.

    Args:
        path: the checkpoint's folder.
        documents: file -> its content.
        base_models: models that the user trusts in addition to `BASE_MODELS`.

    Raises:
        PolicyError: names all untrusted models, and what allows them.
    """
    trusted = {*BASE_MODELS, *base_models}
    untrusted = {
        value: f"{file}: {'.'.join(map(str, place))}"
        for file, document in documents.items()
        for place, value in _leaves(document)
        if isinstance(value, str) and value not in trusted and names_a_model(_key(place), value)
    }
    if untrusted:
        named = " and ".join(f"{where} loads {value!r}" for value, where in untrusted.items())
        it, allowed = "it" if len(untrusted) == 1 else "them", ", ".join([*base_models, *untrusted])
        raise PolicyError(
            f"{path}: {named} in addition to the checkpoint; if you trust {it}, allow {it} in the robot YAML with the "
            f"model's base_models: [{allowed}]"
        )


def _key(place: Sequence[str | int]) -> str:
    """The innermost key of a place in a document."""
    return next((each for each in reversed(place) if isinstance(each, str)), "")


def names_a_model(key: str, value: str) -> bool:
    """Whether LeRobot may interpret the value of a key as a folder or a hub model, and load it."""
    if not value or key in _NOT_LOADED or _PROSE.fullmatch(key):
        return False
    return bool(_NAMES_A_MODEL.fullmatch(key) or _LOOKS_LIKE_A_PATH.match(value))


def whole(path: Path, name: str, value: Any, most: int) -> int:
    """Check that a value is a whole number from 1 to `most`.

    Raises:
        PolicyError: if it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise PolicyError(f"{path}: {name} is {value!r}, must be a whole number from 1 to {most}")
    return value


def shape(path: Path, name: str, value: Any) -> tuple[int, ...]:
    """Check the shape of a feature.

    Raises:
        PolicyError: if it is not a shape, or has too many elements.
    """
    elements = 1
    for n in value if isinstance(value, list) and value else [0]:
        elements *= n if isinstance(n, int) and not isinstance(n, bool) and n > 0 else _MAX_ELEMENTS + 1
    if elements > _MAX_ELEMENTS:
        raise PolicyError(
            f"{path}: the shape of {name} is {value!r}, must be a list of at most {_MAX_ELEMENTS} numbers"
        )
    return tuple(value)


def _leaves(document: Any) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Yield paths and values of all scalars; not recursive, because the file determines the depth."""
    waiting: list[tuple[tuple[str | int, ...], Any]] = [((), document)]
    while waiting:
        place, value = waiting.pop()
        if len(place) <= _MAX_DEPTH and isinstance(value, dict | list):
            items = value.items() if isinstance(value, dict) else enumerate(value)
            waiting += [((*place, key), inner) for key, inner in items]
        else:
            yield place, value
