"""Requests in plain data for declared services: mostly of the right shape, with values at every extreme."""

from __future__ import annotations

import json
import random
from collections.abc import Sequence
from typing import Any, get_args

import attrs

from ibrobot_core.convert import is_array, is_literal, is_mapping, is_sequence, is_union
from ibrobot_core.options import fields
from ibrobot_core.services import Service

SECRET = "IBROBOT_FUZZ_SECRET"
NUMBERS: Sequence[Any] = (
    0, 1, -1, 2, 0.5, -0.5, 0.1, 0.01, 1e-5, 1e-300, 5e-324, 1.0000001, 3.2, 100.0, 1e9, 1e300, 1.7e308, 2**31, 2**63,
    -(2**63), 10**400, float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
TEXTS = (
    "", "home", "rest", "up", "xyz=0.2,0.0,0.1", "xyz=1e308,0,0", "xyz=nan,0,0", "shoulder_pan=0.5",
    "shoulder_pan=1e300",
    "moveit_planning", "teleop", "idle", "success", f"${{{SECRET}}}", "\\u0024{" + SECRET + "}", "~/x", "/etc/passwd",
    "package://ibrobot_core/../x.stl", "a" * 300 + ".stl", "a" * 1001, "a" * 200_000, "\x00", "\x1b[2J", "\ud800",
    "ü 漢",
    "{name: cube}", "steps: [{move: {pose: home}}]", f"steps: [{{move: {{pose: '${{{SECRET}}}'}}}}]", "box", "cube",
    "table", "gripper", "shoulder_pan", "base",
)  # fmt: skip
NAMES = ("shoulder_pan", "elbow_flex", "gripper", "pan", "cube", "x", "", "a" * 1001, "\x00")
_MOST_CHARACTERS = 1_500_000
"""More takes the client longer to encode than the robot to refuse."""
LENGTHS = (0, 1, 2, 3, 3, 3, 4, 6, 21, 101, 2001, 30_000)


class Requests:
    """Makes requests.

    Args:
        seed: equal seeds make equal requests.
    """

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._left = 0

    def request(self, service: Service[Any, Any]) -> Any:
        """A request to a service."""
        self._left = 40_000
        if self._random.random() < 0.05:
            return self._anything(3)
        made = self._of(service.request, 6)
        if isinstance(made, dict) and service.alone and self._random.random() < 0.5:
            return made.get(service.alone)
        return made

    def _of(self, kind: Any, depth: int) -> Any:  # noqa: PLR0911 - one case per kind of type
        chosen = self._random
        if chosen.random() < 0.03 or depth == 0:
            return self._anything(2)
        if is_union(kind):
            return self._of(chosen.choice(get_args(kind)), depth)
        if is_literal(kind):
            return chosen.choice((*get_args(kind), *TEXTS))
        if is_array(kind):
            return [self._number() for _ in range(self._length())]
        if is_mapping(kind):
            return {name: self._of(get_args(kind)[1], depth - 1) for name in chosen.sample(NAMES, chosen.randint(0, 6))}
        if is_sequence(kind):
            return self._list(get_args(kind), depth)
        if kind in (int, float):
            return self._number()
        if kind is bool:
            return chosen.random() < 0.5
        if kind is type(None):
            return None
        if not attrs.has(kind):
            return chosen.choice(TEXTS)
        known = fields(kind)
        given = [name for name, field in known.items() if chosen.random() < (0.3, 0.97)[field.default is attrs.NOTHING]]
        if "xyz" in known and "pose" in known and chosen.random() < 0.8:  # a goal has one of them
            given = [chosen.choice(("pose", "joints", "xyz")), *(name for name in given if "tolerance" in name)]
        made = {name: self._of(known[name].type, depth - 1) for name in given}
        if chosen.random() < 0.03:
            made[chosen.choice(NAMES)] = self._anything(2)
        return made

    def _list(self, kinds: tuple[Any, ...], depth: int) -> list[Any]:
        fixed = len(kinds) > 1 and kinds[1] is not Ellipsis
        if fixed and self._random.random() < 0.9:
            return [self._of(kind, depth - 1) for kind in kinds]
        length = self._length()
        one = [self._of(kinds[0], depth - 1) for _ in range(min(length, 3))]
        most = _MOST_CHARACTERS * len(one) // max(len(json.dumps(one)), 1)
        return (one * length)[: max(min(length, most), len(one))]

    def _length(self) -> int:
        """Number of items; the whole request must stay within what a network carries quickly."""
        length = min(self._random.choice(LENGTHS), max(self._left, 0))
        self._left -= length
        return length

    def _number(self) -> Any:
        if self._random.random() < 0.6:
            return round(self._random.uniform(-0.3, 0.3), 3)
        return self._random.choice(NUMBERS)

    def _anything(self, depth: int) -> Any:  # noqa: PLR0911 - one case per kind of data
        chosen = self._random
        match chosen.randint(0, 6 if depth else 3):
            case 0:
                return self._number()
            case 1:
                return chosen.choice(TEXTS)
            case 2:
                return None
            case 3:
                return chosen.random() < 0.5
            case 4:
                return [self._anything(depth - 1) for _ in range(chosen.randint(0, 4))]
            case 5:
                return {chosen.choice(NAMES): self._anything(depth - 1) for _ in range(3)}
        deep: Any = 1
        self._left -= 1000
        for _ in range(chosen.choice((5, 20, 900))):
            deep = [deep]
        return deep
