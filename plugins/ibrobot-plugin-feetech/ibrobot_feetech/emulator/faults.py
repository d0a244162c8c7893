"""What goes wrong on an emulated bus, by chance or on command."""

from __future__ import annotations

import attrs
import numpy as np


@attrs.define
class Faults:
    """Faults of the replies; any may be changed while the bus is served.

    Probabilities are of each reply, but `corrupt` is of each byte.
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
    """Servo id -> error bits that its replies carry."""
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
