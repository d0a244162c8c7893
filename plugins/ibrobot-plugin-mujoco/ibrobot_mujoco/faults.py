"""Fault injection: determines the active faults at a time of the episode."""

from __future__ import annotations

from collections.abc import Sequence

from ibrobot_core.api import HardwareError, ns
from ibrobot_mujoco.options import Fault


class Faults:
    """The faults of one episode. Times are counted from its beginning [ns]."""

    def __init__(self, faults: Sequence[Fault], joints: Sequence[str]) -> None:
        for fault in faults:
            if fault.joint is not None and fault.joint not in joints:
                raise HardwareError(f"simulation.faults: no joint {fault.joint!r}; the joints are: {', '.join(joints)}")
        self._faults = tuple(faults)
        self._order = {name: i for i, name in enumerate(joints)}
        self._over: set[int] = set()

    def restart(self) -> None:
        """Begin a new episode, in which all faults occur again."""
        self._over.clear()

    def clear(self, now_ns: int) -> None:
        """End the active faults."""
        self._over.update(i for i, _ in self._in_progress(now_ns))

    def active(self, kind: str, now_ns: int) -> bool:
        """Whether a fault of `kind` is active."""
        return any(fault.kind == kind for _, fault in self._in_progress(now_ns))

    def frozen(self, now_ns: int) -> list[int]:
        """Indices of the joints that ignore commands."""
        return [self._order[fault.joint] for _, fault in self._in_progress(now_ns) if fault.joint is not None]

    def _in_progress(self, now_ns: int) -> list[tuple[int, Fault]]:
        return [
            (i, fault)
            for i, fault in enumerate(self._faults)
            if i not in self._over
            and now_ns >= ns(fault.at)
            and (fault.duration is None or now_ns < ns(fault.at + fault.duration))
        ]
