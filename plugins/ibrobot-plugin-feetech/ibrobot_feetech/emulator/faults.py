"""Faults of an emulated bus and its servos, random or injected."""

from __future__ import annotations

import attrs
import numpy as np


@attrs.define
class Faults:
    """Faults of replies and servos. They may be changed at any time, and take effect at the next request.

    Probabilities are per reply, but `corrupt` is per byte. Servos are identified by id.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    late: float = 0.0
    """Probability that a reply is late by `late_s`."""
    late_s: float = 0.05
    delay_s: float = 0.0
    """Additional delay of every reply [s]."""
    silent: set[int] = attrs.field(factory=set)
    """Servos that ignore requests."""
    errors: dict[int, int] = attrs.field(factory=dict)
    """Servo id -> error bits that it reports."""
    blocked: set[int] = attrs.field(factory=set)
    """Servos whose joints do not move; far from its goal, such a servo goes into overload."""
    overloaded: set[int] = attrs.field(factory=set)
    """Servos under maximum load at their present position; they go into overload."""
    disconnected: set[int] = attrs.field(factory=set)
    """Servos without a cable: silent and without torque; their RAM is lost when they return."""
    brown_out: set[int] = attrs.field(factory=set)
    """Servos that lose power for a moment, and thus RAM and torque. Cleared after it has happened."""
    counts: dict[str, int] = attrs.field(
        factory=lambda: dict.fromkeys(("replies", "dropped", "corrupted", "duplicated", "late"), 0)
    )
    """Faults injected so far."""

    def apply(self, reply: bytes, due_s: float, chance: np.random.Generator) -> list[tuple[float, bytes]]:
        """The replies that are actually sent, with their times [s]."""
        self.counts["replies"] += 1
        due_s += self.delay_s
        if self.drop and chance.random() < self.drop:
            self.counts["dropped"] += 1
            return []
        if self.corrupt:
            hit = chance.random(len(reply)) < self.corrupt
            if hit.any():
                self.counts["corrupted"] += int(hit.sum())
                noise = chance.integers(1, 256, len(reply), dtype=np.uint8)
                reply = bytes(np.frombuffer(reply, np.uint8) ^ np.where(hit, noise, 0).astype(np.uint8))
        if self.late and chance.random() < self.late:
            self.counts["late"] += 1
            due_s += self.late_s
        if self.duplicate and chance.random() < self.duplicate:
            self.counts["duplicated"] += 1
            return [(due_s, reply), (due_s, reply)]
        return [(due_s, reply)]
