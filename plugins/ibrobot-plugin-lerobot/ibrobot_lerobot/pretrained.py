"""Requirements of LeRobot's policy types beyond LeRobot itself: extras to install, and weights to download.

Everything is read from the installed LeRobot's metadata and source text, without importing torch.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement

from ibrobot_core.api import MissingDependency, did_you_mean, how_to_install

_EXTRAS = {"pi0": "pi", "pi05": "pi", "pi0_fast": "pi", "wall_x": "wallx"}
"""Policy type -> its extra, if their names differ."""
_HUB = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
"""A repository on the Hugging Face Hub."""
_BACKBONE = re.compile(r"(?P<model>[A-Za-z0-9]+)_Weights\.\w+")
"""Pretrained weights of torchvision, e.g. `ResNet18_Weights.IMAGENET1K_V1`."""
_TOKENIZER = "tokenizer_name"


def check_policy(policy: str, options: Sequence[str], *, download: bool, on_page: bool = False) -> None:
    """Check that a training of this policy type can start on this machine.

    Nothing is checked if LeRobot is installed in another environment.

    Args:
        policy: the policy type, e.g. `act`.
        options: further arguments of `lerobot-train`, which may choose other weights.
        download: whether LeRobot may download weights.
        on_page: whether the error is for a page, which has no field for options of `lerobot-train`.

    Raises:
        MissingDependency: for an unknown type, a missing extra, or weights that are not on this machine.
    """
    spec = find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        return
    policies = Path(spec.submodule_search_locations[0]) / "policies"
    known = sorted(path.parent.name for path in policies.glob("*/modeling_*.py"))
    if policy not in known:
        raise MissingDependency(
            f"--policy: {policy!r} is not a policy type of LeRobot {version('lerobot')}",
            remedy=f"choose another{did_you_mean(policy, known, 'the types are')}",
        )
    if missing := missing_packages(policy):
        raise MissingDependency(
            f"policy {policy} needs {', '.join(missing)}, not installed",
            remedy=how_to_install(f"lerobot[{_extra(policy)}]"),
        )
    if download:
        return
    overrides = dict(option.removeprefix("--policy.").partition("=")[::2] for option in options)
    for key, source in pretrained(policies / policy).items():
        if (wanted := overrides.get(key, source)) and not on_this_machine(wanted):
            raise MissingDependency(
                f"policy {policy} begins with pretrained weights that are not on this machine: {key} is {wanted}",
                remedy="--download lets LeRobot fetch them" + ("" if on_page else f"; {_offline(key, wanted)}"),
            )


def _offline(key: str, source: str) -> str:
    if _BACKBONE.fullmatch(source):
        return f"without a network, --policy.{key}=null begins with random weights"
    return f"without a network, copy {source} to this machine and give its folder: --policy.{key}=FOLDER"


def _extra(policy: str) -> str:
    return _EXTRAS.get(policy, policy.replace("_", "-"))


def missing_packages(policy: str) -> list[str]:
    """The packages of a policy type's extra of LeRobot that are not installed; empty if it needs no extra."""
    needed = distribution("lerobot").requires or []
    return sorted(set(_missing(_extra(policy), [Requirement(each) for each in needed])))


def _missing(extra: str, requirements: Sequence[Requirement]) -> Iterator[str]:
    for each in requirements:
        if each.marker is None or not each.marker.evaluate({"extra": extra}) or each.marker.evaluate({"extra": ""}):
            continue
        if each.name == "lerobot":
            for inner in each.extras:
                yield from _missing(inner, requirements)
            continue
        try:
            version(each.name)
        except PackageNotFoundError:
            yield each.name


def pretrained(folder: Path) -> Mapping[str, str]:
    """Option of a policy -> the weights or tokenizer that LeRobot downloads by default.

    Args:
        folder: the folder of the policy type in LeRobot's source.
    """
    sources: dict[str, str] = {}
    for file in (*folder.glob("configuration_*.py"), *folder.glob("processor_*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            match node:
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.Constant(value=str(text))):
                    pass
                case ast.keyword(arg=str(name), value=ast.Constant(value=str(text))) if name == _TOKENIZER:
                    pass
                case _:
                    continue
            if _HUB.fullmatch(text) or _BACKBONE.fullmatch(text):
                sources[name] = text
    return sources


def on_this_machine(source: str) -> bool:
    """Whether weights are a folder, or in the cache of the Hugging Face Hub or of torch."""
    if backbone := _BACKBONE.fullmatch(source):
        cache = os.environ.get("TORCH_HOME", Path(os.environ.get("XDG_CACHE_HOME", "~/.cache"), "torch"))
        folder = Path(cache).expanduser() / "hub" / "checkpoints"
        return any(folder.glob(f"{backbone['model'].lower()}-*.pth"))
    if not _HUB.fullmatch(source) or Path(source).exists():
        return True  # e.g. null, or a folder
    hub = os.environ.get("HF_HUB_CACHE", Path(os.environ.get("HF_HOME", "~/.cache/huggingface"), "hub"))
    return any((Path(hub).expanduser() / f"models--{source.replace('/', '--')}" / "snapshots").glob("*/*"))
