"""Makes the pairs of a changed world beside the control loop, which takes them over when they are finished."""

from __future__ import annotations

import logging
import queue
import sys
import threading
from collections import deque
from collections.abc import Callable

import attrs

from ibrobot_core.api import PlanningError, Pose
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.pairs import Pairs
from ibrobot_planning.world.arm import Arm
from ibrobot_planning.world.coal_shapes import geometry
from ibrobot_planning.world.objects import Boxes, Voxels, World, WorldObject

_MOST_WAITING = 32
"""Worlds that wait for a loop that takes none, e.g. since the robot holds after a fault; then one takes their place."""
_SWITCH_S = 0.0001
"""How long the thread may keep the loop of the same process waiting [s]; 5 ms is Python's default."""


@attrs.frozen(eq=False)
class Finished:
    """A world that the loop is to take over."""

    stale: str
    """Why it is not known well enough; empty if it is."""
    pairs: Pairs | None = None
    """Those of the new world; None if objects are only elsewhere."""
    moved: tuple[tuple[str, Pose], ...] = ()
    """These, and where they are."""


class Building:
    """Takes changes of the world in, in order, and puts what is finished into `finished`.

    While the world has an object that the guard cannot check, e.g. on an unknown link, the world counts as too old.

    Args:
        arm: the arm.
        permit: adds to a world what the guard knows besides, and what may be touched.
        make: makes the pairs of such a world, with parts of those of the world before, if there are any.
        pairs: those of the world without objects.
        log: for objects that cannot be checked.
        in_thread: whether to build in a thread; else in `add`, as stepped time needs it.
    """

    def __init__(
        self, arm: Arm, permit: Callable[[World], World], make: Callable[[World, Pairs | None], Pairs],
        pairs: Pairs,
        log: logging.Logger, *, in_thread: bool,
    ) -> None:  # fmt: skip
        self._arm, self._permit, self._make, self._log = arm, permit, make, log
        self._pairs = pairs
        """The last pairs."""
        self._world = World()
        """As it was reported."""
        self._made = permit(self._world)
        """That of the last pairs."""
        self._changes: queue.SimpleQueue[WorldChange] = queue.SimpleQueue()
        self._in_thread = in_thread
        self._thread: threading.Thread | None = None
        """Runs while there are changes."""
        self._lock = threading.Lock()
        """Held for the start and the end of the thread, never while it builds."""
        self.finished: deque[Finished] = deque()
        self.old: deque[Pairs] = deque()
        """Those that the loop has no more: freeing them takes longer than it has time."""
        self.changes = self.refused = 0
        """Number of changes, and of objects that could not be checked."""
        self._unusable: dict[str, str] = {}
        """Objects of the present world that cannot be checked -> why."""

    def add(self, change: WorldChange) -> None:
        """Have a change taken in."""
        self._changes.put(change)
        if not self._in_thread:
            self._build([self._changes.get()])
            return
        with self._lock:
            if self._thread is None:
                sys.setswitchinterval(min(_SWITCH_S, sys.getswitchinterval()))
                self._thread = threading.Thread(target=self._run, name="guard", daemon=True)
                self._thread.start()

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._changes.empty():
                    self._thread = None
                    return
            changes = []
            while not self._changes.empty():  # a flood makes one world
                changes.append(self._changes.get())
            self._build(changes)

    def _build(self, changes: list[WorldChange]) -> None:
        while self.old:
            self.old.popleft().let_go()
        world = self._world
        for change in changes:
            unusable = {name: why for name, thing in change.changed.items() if (why := self._fault(name, thing))}
            for name in (*change.removed, *change.changed):
                self._unusable.pop(name, None)
            self._unusable |= unusable
            usable = {name: thing for name, thing in change.changed.items() if name not in unusable}
            world = attrs.evolve(change, changed=usable).apply(world)
        self._world = world
        self.changes += len(changes)
        stale = changes[-1].stale or next(iter(self._unusable.values()), "")
        try:
            world = self._permit(world)
            change = WorldChange.between(self._made, world)
            if len(self.finished) >= _MOST_WAITING:
                self._pairs = self._make(world, None)
                self.finished.clear()
                self.finished.append(Finished(stale, self._pairs))
            elif change.only_moves(world):
                self._pairs.note_moved({name: world.objects[name] for name in change.moved})
                self.finished.append(Finished(stale, None, tuple(change.moved.items())))
            else:
                self._pairs = self._make(world, self._pairs)
                self.finished.append(Finished(stale, self._pairs))
        except Exception as error:  # noqa: BLE001 - whatever it is, the loop must know that the world is another one
            self._log.exception("the guard cannot take in the world")
            self.finished.append(Finished(f"the guard cannot take it in: {type(error).__name__}: {error}"))
        else:
            self._made = world

    def _fault(self, name: str, thing: WorldObject) -> str:
        """Why an object cannot be checked; empty if it can."""
        try:
            World({name: thing}).check(self._arm.frames)
            if not isinstance(thing.shape, Voxels | Boxes):
                geometry(thing.shape)
        except (PlanningError, ValueError, RuntimeError) as error:
            self.refused += 1
            fault = f"the guard cannot check object {name!r}: {error}"
            self._log.error("%s; the world counts as too old until it is removed or replaced", fault)
            return fault
        return ""

    def take(self) -> Finished | None:
        """The oldest world that is finished and not taken over yet."""
        try:
            return self.finished.popleft()
        except IndexError:  # not checked before: a world that replaces the waiting ones may empty the queue meanwhile
            return None
