"""What is known of LeRobot's policy types, one row each; the page about policies has the same table."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from importlib.metadata import distributions
from pathlib import Path
from typing import Literal

import attrs

from ibrobot_core.api import PolicyError
from ibrobot_lerobot.quiet import cause

_PREFIX = "lerobot_policy_"
"""LeRobot imports the packages whose names begin like this: they add policy types to it."""


@attrs.frozen
class PolicyType:
    """A type of LeRobot's, and whether it works here."""

    state: Literal["runs", "unproved", "refused"]
    """`runs`: tested with a network of random weights; `unproved`: nothing speaks against it, but a test
    would need a download, `why`; `refused`: with the error `why`."""
    why: str = ""
    prompt: bool = True
    prefix: bool = False
    """Whether it takes the rest of its previous chunk (LeRobot's real-time chunking)."""


_DOWNLOADS = "LeRobot runs downloaded code for it"
POLICY_TYPES: Mapping[str, PolicyType] = {
    "act": PolicyType("runs", prompt=False),
    "diffusion": PolicyType("runs", prompt=False),
    "eo1": PolicyType("unproved", "its tokeniser and processor are files of Qwen2.5-VL, which only the Hub has"),
    "evo1": PolicyType(
        "unproved",
        "it loads its language model InternVL3 by name, which only the Hub has, beside its own weights",
        prefix=True,
    ),
    "fastwam": PolicyType("unproved", "it always loads the encoders of Wan2.2-TI2V-5B from the Hub"),
    "gaussian_actor": PolicyType("refused", "it returns single actions, and LeRobot runs downloaded code for it"),
    "groot": PolicyType("refused", f"{_DOWNLOADS}; use its own server, by a model of type gr00t"),
    "lingbot_va": PolicyType(
        "refused", "it continues its own pictures from chunk to chunk, and requests here are alone"
    ),
    "molmoact2": PolicyType(
        "unproved",
        "its network is a checkpoint of its own kind, allenai/MolmoAct2, which only the Hub has",
        prefix=True,
    ),
    "multi_task_dit": PolicyType("runs"),
    "pi0": PolicyType("runs", prefix=True),
    "pi05": PolicyType("runs", prefix=True),
    "pi0_fast": PolicyType("refused", _DOWNLOADS),
    "smolvla": PolicyType("runs", prefix=True),
    "tdmpc": PolicyType("refused", "it plans each action from its previous plan, and requests here are alone"),
    "vla_jepa": PolicyType(
        "unproved", "it loads Qwen3-VL and V-JEPA 2 by name, which only the Hub has, beside its own weights"
    ),
    "vqbet": PolicyType("runs", prompt=False),
    "wall_x": PolicyType("refused", _DOWNLOADS),
    "xvla": PolicyType("runs"),
}
"""LeRobot's name -> properties of the type."""
OTHER = PolicyType("unproved")
"""A type of another package."""


def check_type(path: Path, kind: object) -> str:
    """Check the type of a policy.

    Raises:
        PolicyError: if it does not work here, e.g. since LeRobot would run foreign code for it.
    """
    if not isinstance(kind, str):
        raise PolicyError(f"{path}: type is {kind!r}, must be the name of a LeRobot policy")
    known = POLICY_TYPES.get(kind, OTHER)
    if known.state == "refused":
        raise PolicyError(f"{path}: policies of type {kind!r} are not supported: {known.why}")
    return kind


def import_others(path: Path, kind: str) -> None:
    """Import the packages that add policy types to LeRobot, if `kind` is not one of LeRobot's own.

    Raises:
        PolicyError: if none of them adds it.
    """
    from lerobot.configs.policies import PreTrainedConfig

    if kind in POLICY_TYPES:
        return
    failed = _import_packages()
    known = PreTrainedConfig.get_known_choices()
    if kind not in known:
        reason = "; ".join(failed) or f"packages named {_PREFIX}* add types: is the one of {kind!r} installed here?"
        raise PolicyError(f"{path}: LeRobot has no policy type {kind!r}; {reason}")


def _import_packages() -> tuple[str, ...]:
    """Import the packages that add policy types; which cannot be imported, and why."""
    names = sorted({each.metadata["Name"].replace("-", "_") for each in distributions() if each.metadata["Name"]})
    failed = []
    for name in (each for each in names if each.startswith(_PREFIX)):
        try:
            importlib.import_module(name)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - of a package of others, which is named
            failed.append(f"{name} cannot be imported: {type(error).__name__}: {cause(error)}")
    return tuple(failed)
