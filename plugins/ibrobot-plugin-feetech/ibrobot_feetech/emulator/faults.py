"""What goes wrong on an emulated bus and in its servos, by chance or on command."""

from __future__ import annotations

import attrs
import numpy as np


@attrs.define
class Faults:
    """Faults of replies and servos; any may be changed while the bus is served, and takes effect at the next request.

    Probabilities are of each reply, but `corrupt` is of each byte. Servos are named by their ids.
    """

    drop: float = 0.0
    corrupt: float = 0.0
    duplicate: float = 0.0
    late: float = 0.0
    """Of a reply that comes `late_s` later than it should."""
    late_s: float = 0.05
    delay_s: float = 0.0
    """Further delay of every reply [s]."""
    silent: set[int] = attrs.field(factory=set)
    """Servos that neither hear nor answer."""
    errors: dict[int, int] = attrs.field(factory=dict)
    """Servo id -> error bits that it reports."""
    blocked: set[int] = attrs.field(factory=set)
    """Servos whose joints do not move; far from its goal, such a servo goes into overload."""
    overloaded: set[int] = attrs.field(factory=set)
    """Servos that carry all that they can where they stand; they go into overload."""
    disconnected: set[int] = attrs.field(factory=set)
    """Servos without their cable: silent, without torque, and without their RAM when they come back."""
    brown_out: set[int] = attrs.field(factory=set)
    """Servos that lose their supply for a moment: their RAM and torque are gone. Emptied once that has happened."""
    counts: dict[str, int] = attrs.field(
        factory=lambda: dict.fromkeys(("replies", "dropped", "corrupted", "duplicated", "late"), 0)
    )
    """What was done so far."""

    def apply(self, reply: bytes, due_s: float, chance: np.random.Generator) -> list[tuple[float, bytes]]:
        """The replies that really go out, with the times at which they do [s]."""
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
