"""The temporal smoother: merges action chunks into one plan, blends them, and leads into the first one."""

from __future__ import annotations

import math
from collections.abc import Callable

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.robot import FARTHEST, Vector

LONGEST_CHUNK = 1000
"""Largest number of actions in a chunk: a longer plan would occupy a control tick."""
_FIRST_GAINS = 256
_LEAD_SHARE = 0.5
"""Fraction of the limits available to the lead-in; the rest is left to the chunk's own motion."""

Lead = Callable[[Vector, Vector], Vector]


class TemporalSmoother:
    """The plan of a run, and how each arriving chunk changes it.

    Every time step of the plan has a count `c` of the predictions that went into it. A further prediction for it
    gets the weight `w_c`, with `w_k = exp(-coeff * k)` and k = 0 the oldest:

        plan = (plan * cumsum(w)[c - 1] + new * w[c]) / cumsum(w)[c]

    Steps beyond the end of the plan are appended. With smoothing off, the chunk replaces the plan from the chunk's
    start on.

    Chunks are aligned by time, never by a count of executed actions: action i of a chunk belongs to
    `start_ns + i * step_ns`. If a chunk starts between two steps of the plan, it is aligned with the nearest one.
    Observations are stamped on the contract's ticks, so the offset is jitter of at most half a step and does not
    accumulate. Interpolation would low-pass each chunk once more; without it, every action stays as the policy
    returned it. A chunk that does not touch the plan keeps its exact times.

    Not thread-safe; one thread owns it. Arrays returned by `plan` never change afterwards. `enabled` may change between
    chunks; the plan stays.

    Args:
        step_ns: time between actions [ns].
        action_size: numbers in an action, A.
        coeff: `c` in `w_k = exp(-c k)`; positive favours old predictions, negative new ones, 0 is the plain mean.
        enabled: whether chunks blend.
        lead_in: makes the new plan, shape (M, A), continue from the old one, given as its actions at the first two
            steps of the new plan, shape (2, A), or, after the plan ran dry, as the held last action, shape (1, A). A
            plan that begins just where the last one ended continues it. A chunk that arrives before the lead-in has
            ended replaces the plan, led in as well. None if the arm does not hold the last action.
        continues: whether `lead_in` adjusts every chunk that meets a running plan.

    Raises:
        ValueError: for a step or a size below one, or a coefficient out of range.
    """

    def __init__(
        self, step_ns: int, action_size: int, *, coeff: float = 0.01, enabled: bool = True,
        lead_in: Lead | None = None, continues: bool = False,
    ) -> None:  # fmt: skip
        if step_ns < 1:
            raise ValueError(f"step_ns must be at least 1, got {step_ns}")
        if action_size < 1:
            raise ValueError(f"action_size must be at least 1, got {action_size}")
        if not abs(coeff) < 700:
            raise ValueError(f"coeff must lie between -700 and 700, got {coeff}")
        self.step_ns = step_ns
        self.action_size = action_size
        self.enabled = enabled
        self._lead_in = lead_in
        self._continues = continues
        self._ratio = math.exp(-coeff)
        self._gains = _gains(self._ratio, _FIRST_GAINS)
        self.reset()

    def reset(self, held: Vector | None = None) -> None:
        """Discard the plan and the time; the next one begins at `held`, shape (A,), if the arm is held there."""
        self._set(0, np.empty((0, self.action_size)), np.empty(0, dtype=np.intp))
        self._now_ns: int | None = None
        self._held: Vector | None = None if held is None else held[None]
        self._ended_ns: int | None = None
        self._led_until_ns = -1
        """The time of the last action that `lead_in` changed [ns]; before any other without one."""

    def plan(self) -> tuple[int, Vector]:
        """The time of the first action [ns] and the actions, shape (M, A), read-only; `(0, empty)` without a plan."""
        return self._start_ns, self._positions

    def remaining(self, now_ns: int) -> int:
        """The number of actions after `now_ns`; 0 when the plan ran dry."""
        begun = (now_ns - self._start_ns) // self.step_ns + 1
        return min(max(len(self._positions) - begun, 0), len(self._positions))

    def ahead(self, t_ns: int, held: int) -> Vector | None:
        """The commands from `t_ns` on: the plan's actions, shape (K, A), starting with the one nearest to `t_ns`.

        After the plan ran dry: the last action, repeated `held` times (K = held). None before the first plan, if the
        last action is not held, and if the plan begins later.
        """
        offset = (t_ns - self._start_ns + self.step_ns // 2) // self.step_ns
        if len(self._positions) and offset < 0:
            return None
        if offset < len(self._positions):
            return self._positions[offset:]
        last = self._positions[-1:] if len(self._positions) else self._held
        return None if last is None or self._lead_in is None else np.tile(last, (held, 1))

    def trim(self, now_ns: int) -> None:
        """Drop the actions whose step is over at `now_ns`, but keep the current one to interpolate from."""
        self._now_ns = now_ns if self._now_ns is None else max(now_ns, self._now_ns)
        over = (now_ns - self._start_ns) // self.step_ns
        if over >= len(self._positions):
            if len(self._positions):
                self._held = self._positions[-1:]
                self._ended_ns = self._start_ns + len(self._positions) * self.step_ns
            self._set(0, self._positions[:0], self._counts[:0])
        elif over > 0:
            self._set(self._start_ns + over * self.step_ns, self._positions[over:], self._counts[over:])

    def update(self, chunk: NDArray[np.floating], start_ns: int) -> int:
        """Merge a chunk into the plan.

        Args:
            chunk: actions, shape (N, A) with N >= 1.
            start_ns: time of the first action [ns], which is the time of its observation.

        Returns:
            The number of actions merged, without those already past at the last `trim`. 0 means that the chunk
            arrived too late and the plan is unchanged.

        Raises:
            ValueError: for a wrong shape or values that are not finite; the plan is unchanged.
        """
        actions = np.asarray(chunk, dtype=np.float64)
        if actions.ndim != 2 or actions.shape[1] != self.action_size or not len(actions):
            raise ValueError(f"a chunk must have the shape (N, {self.action_size}) with N >= 1, got {actions.shape}")
        if len(actions) > LONGEST_CHUNK:
            raise ValueError(f"a chunk may have {LONGEST_CHUNK} actions, got {len(actions)}")
        if not (np.abs(actions) <= FARTHEST).all():
            raise ValueError(f"a chunk must be finite and within {FARTHEST:g}, got {_first_beyond(actions)}")
        length = len(self._positions)
        offset = (start_ns - self._start_ns + self.step_ns // 2) // self.step_ns
        # Observations are never from the future, so a chunk that begins beyond the end means that the plan ran dry.
        if not length or offset > length or (offset <= 0 and not self.enabled):
            return self._begin(actions, start_ns)
        actions = actions[max(-offset, 0) :]  # a trimmed plan begins with the current action; earlier ones are past
        offset = max(offset, 0)
        if not len(actions):
            return 0
        first_ns = self._start_ns + offset * self.step_ns
        if self.enabled and first_ns > self._led_until_ns:
            self._blend(actions, offset)
        else:
            actions = self._led(self._positions[offset : offset + 2], actions, first_ns)
            counts = np.ones(offset + len(actions), dtype=np.intp)
            counts[:offset] = self._counts[:offset]
            self._set(self._start_ns, np.concatenate((self._positions[:offset], actions)), counts)
        return len(actions)

    def _begin(self, actions: Vector, start_ns: int) -> int:
        """Start a plan from this chunk alone, beginning with the current action."""
        past = 0 if self._now_ns is None else max((self._now_ns - start_ns) // self.step_ns, 0)
        rest = len(actions) - past
        if rest <= 0:
            return 0
        plan, first_ns = actions[past:].copy(), start_ns + past * self.step_ns
        before = self._positions[:2] if len(self._positions) else self._held
        dry = not len(self._positions) and (self._ended_ns is None or first_ns - self._ended_ns > self.step_ns // 2)
        plan = self._led(before, plan, first_ns, dry)
        self._set(first_ns, plan, np.ones(rest, dtype=np.intp))
        return rest

    def _led(self, before: Vector | None, actions: Vector, start_ns: int, dry: bool = False) -> Vector:
        joins = dry or self._continues or start_ns <= self._led_until_ns
        if before is None or not len(before) or self._lead_in is None or not joins:
            return actions
        led = self._lead_in(before, actions)
        changed = np.flatnonzero((led != actions).any(axis=1))
        self._led_until_ns = start_ns + int(changed.max(initial=-1)) * self.step_ns
        return led

    def _blend(self, actions: Vector, offset: int) -> None:
        """Blend `actions` into the plan from step `offset` on; append those beyond its end."""
        length, end = len(self._positions), offset + len(actions)
        shared = min(length, end)
        positions = np.empty((max(length, end), self.action_size))
        positions[:length] = self._positions
        positions[length:] = actions[shared - offset :]
        counts = np.ones(len(positions), dtype=np.intp)
        counts[:length] = self._counts
        overlap, seen = positions[offset:shared], counts[offset:shared]
        if shared > offset and (most := int(seen.max())) >= len(self._gains):
            self._gains = _gains(self._ratio, 2 * most)
        # The formula of the class, divided out: plan + (new - plan) * w[c] / cumsum(w)[c].
        overlap += (actions[: shared - offset] - overlap) * self._gains[seen, None]
        seen += 1
        self._set(self._start_ns, positions, counts)

    def _set(self, start_ns: int, positions: Vector, counts: NDArray[np.intp]) -> None:
        self._start_ns, self._positions, self._counts = (start_ns if len(positions) else 0), positions, counts
        positions.flags.writeable = False


def _gains(ratio: float, size: int) -> Vector:
    """`w_c / (w_0 + … + w_c)` for c < size, shape (size,), with `w_k = ratio**k`; free of overflow."""
    gains = [1.0]
    while len(gains) < size:
        step = ratio * gains[-1]
        gains.append(step / (1.0 + step))
    return np.array(gains)


def _first_beyond(actions: Vector) -> str:
    row, column = np.argwhere(~(np.abs(actions) <= FARTHEST))[0]
    return f"{actions[row, column]} in action {row}, element {column}"


@attrs.frozen(eq=False)
class LeadIn:
    """Makes a chunk start at the held position, or on the previous plan.

    Args:
        step_s: time between actions [s].
        max_velocity: of each joint [rad/s], shape (A,).
        max_acceleration: of each joint [rad/s^2], shape (A,).
    """

    step_s: float
    max_velocity: Vector
    max_acceleration: Vector

    def __call__(self, before: Vector, actions: Vector) -> Vector:
        """Return the actions, shape (N, A), changed so that they continue from `before`.

        The differences in position and speed are added to the actions and fade out along a cubic, which uses half of
        the limits of the joint with the longest way. A chunk shorter than the cubic ends before it has faded out.

        Args:
            before: the commands without the new chunk: those at the first and second action, shape (2, A); or the
                position at which the arm is held, shape (1, A).
            actions: the new commands.
        """
        gap = before[0] - actions[0]
        if not gap.any():
            return actions  # they already continue from there
        lag = before[-1] - before[0] - (actions[1 % len(actions)] - actions[0])
        speed = np.abs(lag) / self.step_s
        # Over a time T, the cubic from a distance has the peaks 1.5 / T and 6 / T^2, the one from a speed 1 and 4 / T.
        limit = _LEAD_SHARE * self.max_acceleration
        by_acceleration = (2 * speed + np.sqrt(4 * speed**2 + 6 * limit * np.abs(gap))) / limit
        by_velocity = 1.5 * np.abs(gap) / (_LEAD_SHARE * self.max_velocity)
        steps = math.ceil(max(by_velocity.max(), by_acceleration.max()) / self.step_s)
        s = np.minimum(np.arange(len(actions)) / steps, 1.0)[:, None]
        result: Vector = actions + (1 - s**2 * (3 - 2 * s)) * gap + steps * s * (1 - s) ** 2 * lag
        return result
