"""The chains of a robot: arms, legs or fingers, each a joint group with its gripper."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import attrs
import mujoco

_LEAST = 3
"""Joints that make a chain a group of its own; shorter ones beside it share one group."""
_SIDES = {"l": "left", "r": "right"}


@attrs.frozen
class Chain:
    """Joints that move one after another, and those of its gripper."""

    name: str
    joints: tuple[str, ...]
    gripper: tuple[str, ...]

    @property
    def gripper_group(self) -> str:
        """Name of the group of the gripper."""
        return "gripper" if self.name == "arm" else f"{self.name}_gripper"


def parents_of(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, str | None]:
    """Joint -> the next of these joints towards the base; None if there is none."""
    of_body: dict[int, list[str]] = {}
    for name in joints:
        of_body.setdefault(int(model.joint(name).bodyid[0]), []).append(name)
    parents: dict[str, str | None] = {}
    for body, names in of_body.items():
        above = int(model.body_parentid[body])
        while above and above not in of_body:
            above = int(model.body_parentid[above])
        for first, second in zip([of_body[above][-1] if above else None, *names], names, strict=False):
            parents[second] = first
    return parents


def chains_of(parents: Mapping[str, str | None], grips: Sequence[str]) -> tuple[Chain, ...]:
    """The chains of a robot.

    Args:
        parents: joint -> the next one towards the base, or None.
        grips: the joints of grippers.
    """
    arm = [name for name in parents if name not in grips]
    parts = _unbranched({name: _above(name, parents, arm) for name in arm})
    if len(parts) > 1 and (long := [part for part in parts if len(part) >= _LEAST]):
        rest = [name for part in parts if len(part) < _LEAST for name in part]
        parts = [*long, *([rest] if rest else [])]
    else:
        long, rest = parts, []
    names = _names(long) + (["body"] if rest else [])
    owner = {joint: i for i, part in enumerate(parts) for joint in part}
    grippers: dict[int, list[str]] = {}
    for name in grips:
        above = _above(name, parents, arm)
        grippers.setdefault(owner[above] if above is not None else 0, []).append(name)
    return tuple(
        Chain(name, tuple(part), tuple(grippers.get(i, ())))
        for i, (name, part) in enumerate(zip(names, parts, strict=True))
    )


def _above(name: str, parents: Mapping[str, str | None], among: Sequence[str]) -> str | None:
    above = parents[name]
    while above is not None and above not in among:
        above = parents[above]
    return above


def _unbranched(parents: Mapping[str, str | None]) -> list[list[str]]:
    """Parts without a branch, in the order of their first joints."""
    children: dict[str | None, list[str]] = {}
    for name, parent in parents.items():
        children.setdefault(parent, []).append(name)
    parts: list[list[str]] = []
    for name, parent in parents.items():
        if parent is not None and len(children[parent]) == 1:
            next(part for part in parts if part[-1] == parent).append(name)
        else:
            parts.append([name])
    return parts


def _names(parts: Sequence[Sequence[str]]) -> list[str]:
    """A name for each part: the word that all its joints and those of no other part have, e.g. left."""
    if len(parts) == 1:
        return ["arm"]
    words = [set.intersection(*({*_words(name)} for name in part)) for part in parts]
    names = []
    for i, part in enumerate(parts):
        others = {word for j, other in enumerate(parts) if j != i for name in other for word in _words(name)}
        own = [word for word in _words(part[0]) if word in words[i] and word not in others]
        named = next((word for word in own if not word.isdigit()), next(iter(own), ""))
        names.append(f"arm_{named}" if named.isdigit() else named)
    if not all(names) or len({*names}) < len(names) or {"body", "arm", "gripper"} & {*names}:
        return [f"chain_{i}" for i in range(1, len(parts) + 1)]
    return names


def _words(name: str) -> list[str]:
    return [_SIDES.get(word, word) for word in re.split(r"[^A-Za-z0-9]+", name.lower()) if word]
