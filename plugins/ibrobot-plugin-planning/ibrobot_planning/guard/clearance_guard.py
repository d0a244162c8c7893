"""The guard `clearance`: each command comes with a motion that stops the arm, and whose whole way is clear."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any, override

import numpy as np
import pinocchio
from ibrobot_kinematics.poses import matrix

from ibrobot_core.api import Context, PlanningError, SteppedClock, Vector, seconds
from ibrobot_core.app import Guard
from ibrobot_planning.guard.building import Building, Finished
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.joints import ModelJoints, footprint
from ibrobot_planning.guard.options import BASE, ClearanceGuardOptions
from ibrobot_planning.guard.pairs import Indices, Pairs
from ibrobot_planning.guard.permissions import Permissions
from ibrobot_planning.world.arm import Arm
from ibrobot_planning.world.checked_arm import may_touch_arm
from ibrobot_planning.world.objects import World

_HISTORY_S = 0.5
"""How long a joint may lag behind its commands and still be on their path [s]."""
_DECAY_S = 1.0
"""Time in which the greatest distance from the path is forgotten by a factor of e [s]."""
_HALVINGS = 3
"""How finely the share of a motion that leads nearer is chosen."""
_MOST = 300
"""How much is looked at in a tick, which bounds its time; see `Pairs.left`."""
_MOST_BLOCKING = 24
"""Pairs of which a motion that slides takes account: the nearest ones."""
_WAIT_S, _MOST_WAITS = 0.0005, 20
"""How long, and how often, the thread that builds worlds waits for the loop [s]."""
_ROUNDS = 3
"""How often a motion that slides is changed because of further pairs."""
_SWEEPS = 8
"""How often a motion is projected in turn on what each of several pairs permits."""


class ClearanceGuard(Guard):
    """Accepts a command if the arm stays clear on the way to it and while it brakes from it at its limits.

    Otherwise it takes the part of the motion that leads no pair nearer that is too near, as much of the rest as is
    clear, or else brakes. Braking was checked with the command of the tick before.

    Args:
        options: options in the YAML.
        context: robot, period and log.
    """

    def __init__(self, options: ClearanceGuardOptions, context: Context) -> None:
        self._options = options
        robot = context.robot
        if options.base is not None:
            model: tuple[Arm, ModelJoints] = footprint(options.base, robot)
        else:
            try:
                model = may_touch_arm(robot, context.log), ModelJoints(np.arange(len(robot.joints)))
            except PlanningError as error:
                raise PlanningError(f"{error}; control.guard: null switches the guard off", error.code) from None
        self._arm, self._joints = model
        columns = self._joints.columns
        if self._arm.only_visible:
            links = ", ".join(self._arm.only_visible)
            context.log.info("the guard takes hulls of visible meshes for links without collision geometry: %s", links)
        if self._arm.unmoved:
            message = "the guard keeps joints of the model that the robot lacks at their reference position: %s"
            context.log.warning(message, ", ".join(self._arm.unmoved))
        period_s = seconds(context.period_ns)
        self._period_s = period_s
        self._change: Vector = robot.max_acceleration[columns] * period_s**2
        self._follows = ~np.asarray(robot.grips)[columns]
        self._permissions = Permissions(options, robot, self._arm)
        self._begin: Vector = np.zeros(len(self._arm.joint_names))
        """The configuration of the model at the last command [rad], shape (M,)."""
        self._is_checking = False
        self._pairs = self._made(self._permissions.applied(World()), None)
        in_thread = not isinstance(context.clock, SteppedClock)
        self._building = Building(
            self._arm, self._permissions.applied, self._made, self._pairs, context.log, in_thread=in_thread
        )
        self._stale = self._label = ""
        self._pair: tuple[str, ...] = ()
        """What the last setpoint was about to touch."""
        size = len(columns)
        self._past: Vector = np.full((max(2, round(_HISTORY_S / period_s)), size), np.nan)
        """The last commands, the newest one last [rad], shape (H, J)."""
        self._away: Vector = np.zeros(size)
        """Largest distance of each joint from the path of its commands, fading [rad], shape (J,)."""
        self._fade = float(np.exp(-period_s / _DECAY_S))
        self._reach = np.abs(self._joints.rates(self._pairs.levers.max(axis=0, initial=0.0)[None]))[0]
        self._strays: Vector = np.zeros(len(self._begin))
        """Largest distance of each joint of the model from where it is commanded [rad], shape (M,)."""
        self._counts = {"ticks": 0, "slid": 0, "braked": 0, "stale": 0}

    @override
    def world(self, change: Mapping[str, Any]) -> None:
        self._building.add(WorldChange.read(change))

    @property
    def counts(self) -> Mapping[str, int]:  # type: ignore[override]
        """Ticks with a changed setpoint (`ticks`), those in which the arm slid or braked, and what the world did."""
        building, pairs = self._building, self._pairs
        of_world = {"world_changes": building.changes, "refused_objects": building.refused}
        return self._counts | of_world | {"distances": pairs.measured, "pairs": len(pairs.names)}

    @property
    def strays(self) -> Vector:
        """How far the margin of the last command lets each joint of the model be from its path [rad], shape (M,)."""
        return self._strays.copy()

    @override
    def accept(self, position: Vector, velocity: Vector, setpoint: Vector, measured: Vector) -> Vector:
        columns = self._joints.columns
        accepted: Vector = setpoint.copy()
        self._is_checking = True
        try:
            own = (each[columns] for each in (position, velocity, setpoint, measured))
            accepted[columns] = self._checked(*own)
        finally:
            self._is_checking = False
        return accepted

    def _checked(self, position: Vector, velocity: Vector, setpoint: Vector, measured: Vector) -> Vector:
        """As `accept`, of the joints of the model."""
        self._joints.note(measured)
        self._begin = self._joints.path(position[None])[0]
        while (finished := self._building.take()) is not None:
            self._take(finished)
        self._note(position, measured)
        self._pairs.left = _MOST
        step = velocity * self._period_s
        fastest = np.maximum(np.abs(step), np.abs(setpoint - position))
        ahead = fastest + fastest**2 / (2 * self._change) + np.nan_to_num(np.abs(position - measured))
        self._strays = self._joints.strays(self._away, fastest, ahead)
        brakes: Vector = position + np.sign(step) * np.maximum(np.abs(step) - self._change, 0.0)
        return self._accepted(position, brakes, setpoint)

    def _accepted(self, position: Vector, brakes: Vector, setpoint: Vector) -> Vector:
        before, self.overruled = self._pair, ""
        self._pair = ()
        if self._stale and self._options.when_stale == "hold" and not np.array_equal(setpoint, brakes):
            self._counts["stale"] += 1
            self.overruled = self._said("world", self._stale, None)
            return brakes
        blocking = self._blocking(position, setpoint)
        if not len(blocking):
            return setpoint
        self._counts["ticks"] += 1
        blocking = blocking[np.argsort(self._pairs.distances(self._begin, blocking), kind="stable")[:_MOST_BLOCKING]]
        nearest = int(blocking[0])
        self._pair, blocking = self._pairs.names[nearest], np.sort(blocking)
        if self._pair != before:
            alike = np.flatnonzero([names == self._pair for names in self._pairs.names])
            away = float(self._pairs.distances(self._begin, alike).min())
            self._label = self._said(*self._pair, away, self._strayed(nearest))
        self.overruled = self._label
        lowest, highest = np.minimum(brakes, setpoint), np.maximum(brakes, setpoint)
        for _ in range(_ROUNDS):
            slides = self._along(position, setpoint, lowest, highest, blocking)
            further = self._blocking(position, slides)
            if not len(further):
                self._counts["slid"] += 1
                return self._most(position, slides, setpoint)
            if np.isin(further, blocking).all() or self._pairs.left <= 0:
                break
            blocking = np.union1d(blocking, further)
        self._counts["braked"] += 1
        return self._most(position, brakes, slides)

    def _most(self, position: Vector, clear: Vector, wanted: Vector) -> Vector:
        """The last clear command on the way from one that is clear to one that is wanted, halving the way."""
        best, low, high = clear, 0.0, 1.0
        for _ in range(_HALVINGS):
            if self._pairs.left <= 0:
                break
            middle = (low + high) / 2
            command = clear + middle * (wanted - clear)
            if len(self._blocking(position, command)):
                high = middle
            else:
                best, low = command, middle
        return best

    def _blocking(self, position: Vector, command: Vector) -> Indices:
        """Pairs that come too near on the way to a command and while braking from it; none if it is clear."""
        pairs, path = self._pairs, self._path(position, command)
        least, most = path.min(axis=0), path.max(axis=0)
        suspect = pairs.unproved(least, most, self._strays)
        if len(suspect):
            pairs.distances((path[0] + path[-1]) / 2, suspect)
            suspect = pairs.still_unproved(least, most, self._strays, suspect)
        if not len(suspect):
            return suspect
        required = pairs.required(path[0], suspect, self._strays)
        return pairs.first_blocked(path, suspect, required)

    def _path(self, position: Vector, command: Vector) -> Vector:
        """The way to a command and to rest, at each tick, of the joints of the model [rad], shape (N, M)."""
        step = command - position
        ticks = max(1, int(np.ceil(np.abs(step) / self._change).max()))
        steps = np.abs(step) - self._change * np.arange(ticks)[:, None]
        moved = np.cumsum(np.copysign(np.maximum(steps, 0.0), step), axis=0)
        return self._joints.path(np.concatenate([position[None], position + moved]))

    def _along(self, position: Vector, setpoint: Vector, lowest: Vector, highest: Vector, blocking: Indices) -> Vector:
        """The command nearest to `setpoint`, within bounds, that leads no blocking pair nearer, if there is one."""
        self._pairs.distances(self._begin, blocking)
        gradients = self._joints.rates(self._pairs.gradients(blocking))
        step = setpoint - position
        for _ in range(_SWEEPS):
            before = step
            for gradient in gradients:
                rate = float(gradient @ step)
                if rate < 0:
                    step = step - gradient * (rate / float(gradient @ gradient))
            step = np.minimum(np.maximum(step, lowest - position), highest - position)
            if np.array_equal(step, before):
                break
        return position + step

    def _note(self, position: Vector, measured: Vector) -> None:
        """Take in the last command and where the joints are."""
        past, weights = self._past, self._reach**2
        past[:-1] = past[1:] if np.isfinite(past[-1]).all() else position
        past[-1] = position
        self._away *= self._fade
        known = np.isfinite(measured)
        if not known.all():
            measured = np.where(known, measured, position)
        # The nearest place on the way from each command to the next one: at a low rate, these are far apart.
        behind, steps = measured - past[:-1], np.diff(past, axis=0)
        lengths = (steps**2) @ weights
        shares = ((behind * steps) @ weights) / np.where(lengths > 0, lengths, 1.0)
        gaps = np.abs(behind - np.minimum(np.maximum(shares, 0.0), 1.0)[:, None] * steps)
        nearest = gaps[int((gaps @ self._reach).argmin())]
        self._away = np.maximum(self._away, np.where(self._follows, nearest, 0.0))

    def _take(self, finished: Finished) -> None:
        """Have a world that is finished."""
        self._stale = finished.stale
        if finished.pairs is not None:
            finished.pairs.take_over(self._pairs, self._begin)
            self._building.old.append(self._pairs)
            self._pairs = finished.pairs
        if finished.moved:
            placements = {name: pinocchio.SE3(matrix(pose)) for name, pose in finished.moved}
            self._pairs.move(placements, self._begin)

    def _made(self, world: World, before: Pairs | None) -> Pairs:
        """The pairs of a world with what may be touched; also called in another thread."""
        options, pressed = self._options, self._permissions.pressed
        margins = {} if options.base is None else {BASE: options.base.margin}
        made = Pairs(
            self._arm, world, margin=options.margin, self_margin=options.self_margin, pressed=pressed, margins=margins,
            before=before, pause=self._give_way,
        )  # fmt: skip
        made.estimate(self._begin, before)
        return made

    def _give_way(self) -> None:
        """Wait while the loop checks a command, but not for ever: two threads that run by turns take twice as long."""
        for _ in range(_MOST_WAITS):
            if not self._is_checking:
                return
            time.sleep(_WAIT_S)

    def _strayed(self, pair: int) -> str:
        """The joint that is off its commands so far that a pair must stay apart by more than twice its margin."""
        widened = self._pairs.levers[pair] * self._strays
        joint = int(widened.argmax())
        if widened[joint] <= max(self._options.margin, self._options.self_margin, self._pairs.margins[pair]):
            return ""
        unit = "m" if self._arm.slides[joint] else "rad"
        return f", and {self._arm.joint_names[joint]} was {self._strays[joint]:.2f} {unit} from its commands"

    def _said(self, first: str, second: str, distance: float | None, why: str = "") -> str:
        """As `overruled`: two things and their distance [m], or `world` and why it is not known well enough."""
        away = None if distance is None else round(distance, 4)
        text = f"{first}: {second}" if away is None else f"{first} was {1000 * away:.1f} mm from {second}{why}"
        label = {"first": first, "second": second, "distance": away, "text": text}
        return json.dumps({**label, "sound": True} if self._options.sound else label)
