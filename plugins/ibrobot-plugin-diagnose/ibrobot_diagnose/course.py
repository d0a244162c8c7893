"""What happened between the model's answers and the arm, tick by tick."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import attrs
import numpy as np
from ibrobot_provenance.recorded_names import OPERATOR
from numpy.typing import NDArray

from ibrobot_core.api import NS_PER_S
from ibrobot_diagnose.window import Asked, Floats, Times, Window

type Flags = NDArray[np.bool_]

AT_LIMIT = 0.97
"""Share of a velocity limit from which a command counts as limited."""
CONFLICT = 0.06
"""Difference between answers for the same time from which they are not the same [rad]."""
_BEHIND = 0.02
"""Distance from the plan from which a command has not caught up with it [rad]."""
_MOVED = 0.05
"""An arm has begun to move when a command is so far from the first one [rad]."""


@attrs.frozen(eq=False)
class Course:
    """The run from the first used answer on, at the contract's ticks. All vectors have the shape (T, J) [rad]."""

    window: Window
    times_ns: Times
    wanted: Floats
    """What the newest answer says for the tick; NaN where it has ended."""
    planned: Floats
    """The plan: `wanted`, blended with older answers if the robot blends."""
    command: Floats
    state: Floats
    newest: NDArray[np.intp]
    """Index of the newest answer among the used ones."""
    dry: Flags
    """Whether the plan had run dry."""
    operated: Flags
    """Whether an operator had the arm, or nobody in a handover."""

    @cached_property
    def acting(self) -> Flags:
        """Whether the policy commanded, with a plan."""
        return (
            ~self.dry & ~self.operated & np.isfinite(self.planned).all(axis=1) & np.isfinite(self.command).all(axis=1)
        )

    @cached_property
    def at_velocity(self) -> NDArray[np.bool_]:
        """Whether the command moves as fast as the joint may, shape (T, J)."""
        limits = np.array([each.velocity for each in self.window.limits])
        speed = np.abs(np.diff(self.command, axis=0, prepend=self.command[:1])) * self.window.contract.rate_hz
        return np.nan_to_num(speed) >= AT_LIMIT * limits

    @cached_property
    def at_position(self) -> NDArray[np.bool_]:
        """Whether the command is at a position limit that the plan exceeds, shape (T, J)."""
        lower = np.array([each.lower for each in self.window.limits])
        upper = np.array([each.upper for each in self.window.limits])
        near = 0.005
        return ((self.command <= lower + near) & (self.planned < lower - near)) | (
            (self.command >= upper - near) & (self.planned > upper + near)
        )

    @cached_property
    def at_limits(self) -> Mapping[str, NDArray[np.bool_]]:
        """Kind of a limit -> whether it changes the command, each of shape (T, J)."""
        steps = np.diff(self.command, axis=0, prepend=self.command[:1], append=self.command[-1:])
        change = np.abs(np.diff(steps, axis=0)) * self.window.contract.rate_hz**2
        most = np.array([each.acceleration for each in self.window.limits])
        lead = np.abs(self.command - self.state)
        changed = np.nan_to_num(np.abs(self.command - self.planned)) > _BEHIND
        return {
            "velocity": self.at_velocity, "position": self.at_position,
            "acceleration": changed & (np.nan_to_num(change) >= AT_LIMIT * most),
            "lead": changed & (np.nan_to_num(lead) >= AT_LIMIT * self.window.leads),
        }  # fmt: skip

    @cached_property
    def shares(self) -> Mapping[str, float]:
        """Where the difference between what the newest answer said and where the arm was arose: mean [rad]."""
        acting, guarded, changed = self.acting, self._guarded, self.command - self.planned
        parts = {
            "blending": self.planned - self.wanted, "guard": np.where(guarded, changed, 0.0),
            "limits": np.where(self._limited & ~guarded, changed, 0.0),
            "other changes of the plan": np.where(self._limited | guarded, 0.0, changed),
            "following": self.state - self.command,
        }  # fmt: skip
        return {name: _mean(np.abs(values[acting])) for name, values in parts.items()}

    @cached_property
    def _limited(self) -> NDArray[np.bool_]:
        """Whether a limit is at work, or the command has not caught up since."""
        return self._lasting(np.logical_or.reduce(list(self.at_limits.values())))

    @cached_property
    def _guarded(self) -> NDArray[np.bool_]:
        """Whether the guard holds the command back, or it has not caught up since."""
        times = np.array([since for since, _ in self.window.guarded], np.int64)
        held = np.array([False, *(bool(label) for _, label in self.window.guarded)])
        at_work = held[np.searchsorted(times, self.times_ns, side="right")]
        return self._lasting(np.repeat(at_work[:, None], len(self.window.joints), axis=1))

    def _lasting(self, flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Flags that last until the command has caught up with the plan."""
        behind = np.abs(self.command - self.planned) > _BEHIND
        result = flags.copy()
        for row in range(1, len(result)):
            result[row] |= result[row - 1] & behind[row]
        return result

    def table(self) -> list[dict[str, Any]]:
        """A row for each tick, for the JSON report."""
        used = [each for each in self.window.asked if each.used]
        rows = []
        for i, t_ns in enumerate(self.times_ns.tolist()):
            asked = used[self.newest[i]]
            who = "operator" if self.operated[i] else "hold" if self.dry[i] else "policy"
            row = {
                "t_s": round(self.window.since(t_ns), 4), "request": asked.answer.request, "by": who,
                "observation_age_ms": round((t_ns - asked.answer.observed_ns) / 1e6, 2),
                "latency_ms": round(asked.answer.latency_ms, 2), "past_actions": asked.past,
                "blending_rad": _mean(np.abs(self.planned[i] - self.wanted[i])),
                "limits_rad": _mean(np.abs((self.command - self.planned)[i]) * (self._limited & ~self._guarded)[i]),
                "following_rad": _mean(np.abs(self.state[i] - self.command[i])),
                "guard_rad": _mean(np.abs((self.command - self.planned)[i]) * self._guarded[i]),
                "at_limit": [
                    f"{self.window.joints[j]} {kind}"
                    for kind, flags in self.at_limits.items() for j in np.flatnonzero(flags[i])
                ],
            }  # fmt: skip
            rows.append(row)
        return rows


def _mean(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else 0.0


def course_of(window: Window) -> Course | None:
    """The course of a run; None if no answer of its model was used, or there are no commands."""
    used = [each for each in window.asked if each.used and each.answer.joint_names == window.joints]
    if not used or "commands" not in window.streams or "state" not in window.streams:
        return None
    begun = used[0].answer.header.stamp_ns
    times = window.ticks_ns[(window.ticks_ns >= begun) & (window.ticks_ns <= window.command.times_ns[-1])]
    if not len(times):
        return None
    arrived = np.array([each.answer.header.stamp_ns for each in used], np.int64)
    newest = np.maximum(np.searchsorted(arrived, times, side="right") - 1, 0)
    blends, coefficient = blending(window)
    size = (len(times), len(window.joints))
    wanted, planned = np.full(size, np.nan), np.zeros(size)
    total, order = np.zeros(len(times)), np.zeros(len(times), np.intp)
    for number, (begin, rows) in enumerate(_predictions(used, times)):
        part = slice(begin, begin + len(rows))
        current = newest[part] == number
        wanted[part][current] = rows[current]
        known = np.isfinite(rows[:, 0])
        weight = np.where(known, np.exp(-coefficient * order[part]), 0.0) if blends else (known & current).astype(float)
        planned[part] += weight[:, None] * np.nan_to_num(rows)
        total[part] += weight
        order[part] += known
    with np.errstate(invalid="ignore", divide="ignore"):
        planned /= total[:, None]
    who = window.commander_at(times)
    operated = np.array([each not in ("", "policy") for each in who], np.bool_)
    command, state = window.command.between(times), window.state.between(times)
    return Course(window, times, wanted, planned, command, state, newest, total == 0, operated)


def _predictions(used: Sequence[Asked], times: Times) -> Iterator[tuple[int, Floats]]:
    """For each answer, the first tick for which it may count, and its actions from there on; NaN after its end."""
    for each in used:
        own = each.times_ns
        since_ns = max(each.answer.header.stamp_ns, int(own[0]) - each.answer.step_ns // 2)
        begin = int(np.searchsorted(times, since_ns))
        end = int(np.searchsorted(times, own[-1] + each.answer.step_ns, side="right"))
        yield begin, _at(own, each.chunk, times[begin:end], each.answer.step_ns)


def conflict_of(course: Course) -> Floats:
    """Distance of the plan from the nearest of the answers that it blends [rad], shape (T,); 0 for fewer than two."""
    used = [each for each in course.window.asked if each.used and each.answer.joint_names == course.window.joints]
    nearest, count = np.full(len(course.times_ns), np.inf), np.zeros(len(course.times_ns), np.intp)
    for begin, rows in _predictions(used, course.times_ns):
        part = slice(begin, begin + len(rows))
        far = np.abs(course.planned[part] - rows).max(axis=1, initial=0.0)
        known = np.isfinite(far)
        nearest[part] = np.where(known, np.minimum(nearest[part], far), nearest[part])
        count[part] += known
    return np.where(count > 1, nearest, 0.0)


def chance_of_noise(window: Window) -> float:
    """Chance that answers which err around one intention change to and fro for the same times as these do.

    Of two intentions, each change beyond `CONFLICT` takes back the one before, along the direction in which answers
    change most. Of noise around one, two in three do; of a drift, few. So this is the chance of at least so many in as
    many trials; 1 without any.
    """
    used = [each for each in window.asked if each.used and each.answer.joint_names == window.joints]
    changes = []
    for one, other in itertools.pairwise(used):
        times = other.times_ns[other.times_ns <= one.times_ns[-1]]
        if len(times) > 1:
            moved = _at(other.times_ns, other.chunk, times, 1) - _at(one.times_ns, one.chunk, times, 1)
            changes.append(np.nanmedian(moved, axis=0))
    if len(changes) < 2:
        return 1.0
    rows = np.nan_to_num(np.array(changes))
    along = rows @ np.linalg.svd(rows, full_matrices=False)[2][0]
    signs = np.sign(along[np.abs(along) > CONFLICT])
    count, back = max(0, len(signs) - 1), int((signs[1:] != signs[:-1]).sum())
    return float(sum(math.comb(count, each) * 2**each for each in range(back, count + 1)) / 3**count)


def _at(own_ns: Times, values: Floats, t_ns: Times, step_ns: int) -> Floats:
    """A chunk's actions at these times, interpolated; its last one lasts for a step. Shape (T, J)."""
    at = (t_ns - own_ns[0]).astype(np.float64)
    places = (own_ns - own_ns[0]).astype(np.float64)
    columns = np.stack([np.interp(at, places, column) for column in values.T], axis=1)
    columns[(at < -step_ns / 2) | (at > places[-1] + step_ns)] = np.nan
    return columns


def blending(window: Window) -> tuple[bool, float]:
    """Whether the robot blends chunks, and the coefficient of the weights."""
    dispatch = window.mode.get("dispatch") or {}
    smoothing = dispatch.get("smoothing") or {}
    strategy = dispatch.get("strategy") or ("ensemble" if smoothing.get("enabled", True) else "replace")
    return strategy == "ensemble", float(smoothing.get("temporal_ensemble_coeff", 0.01))


def delay_of(window: Window, most_s: float = 0.5) -> tuple[Floats, Floats]:
    """How the arm follows: the delay of each joint [s], and what is left of the error then [rad rms]; shape (J,).

    NaN for a joint whose command moves too little to tell.
    """
    step_ns = min(window.contract.step_ns, 20_000_000)
    t_ns = np.arange(window.start_ns, int(window.ticks_ns[-1]) + 1, step_ns, dtype=np.int64)
    state, command = window.state.between(t_ns), window.command.between(t_ns)
    count = round(most_s * NS_PER_S / step_ns)
    delays, rests = (np.full(len(window.joints), np.nan) for _ in range(2))
    for j in range(len(window.joints)):
        known = np.isfinite(state[:, j]) & np.isfinite(command[:, j])
        if known.sum() < 2 * count or np.ptp(command[known, j]) < 0.05:
            continue
        errors = []
        for lag in range(count + 1):
            moved = (state[lag:, j] - command[: len(command) - lag, j])[known[lag:] & known[: len(known) - lag]]
            errors.append(float(np.sqrt(np.mean(moved**2))) if len(moved) else np.inf)
        best = int(np.argmin(errors))
        delays[j], rests[j] = best * step_ns / NS_PER_S, errors[best]
    return delays, rests


def begins_to_move(window: Window) -> float:
    """Time from the first to the first command that differs from it by more than 0.05 rad [s]."""
    values = window.command.values
    known = np.isfinite(values).all(axis=1)
    if not known.any():
        return 0.0
    times, values = window.command.times_ns[known], values[known]
    moved = np.abs(values - values[0]).max(axis=1, initial=0.0) > _MOVED
    end = int(times[moved.argmax()]) if moved.any() else int(window.ticks_ns[-1])
    return (end - int(times[0])) / 1e9


def operated_share(window: Window) -> tuple[float, float | None]:
    """Share of the ticks that an operator commanded, and the time of the first takeover [s]."""
    who = window.commander_at(window.ticks_ns)
    flags = np.array([each == OPERATOR for each in who], np.bool_)
    return (float(flags.mean()), window.since(int(window.ticks_ns[flags.argmax()]))) if flags.any() else (0.0, None)
