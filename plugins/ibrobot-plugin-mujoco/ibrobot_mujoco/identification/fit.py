"""The fit: parameters with which the simulated arm moves as the recorded one did, and how well they are known.

Nonlinear least squares by SciPy. A parameter is changed on all joints at once, and each joint's error counts for its
own parameter alone, so that a step takes one simulation for each parameter, not for each parameter of each joint. Weak
priors around the published servo keep what the recordings do not show. Positions alone show ratios of torques and
inertias, and no more where gravity does not act, so the prior of the rotor's inertia, which all servos of a type share,
is the tightest one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise

import attrs
import numpy as np
from scipy.optimize import least_squares

from ibrobot_core.api import Vector
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.identification.simulation import WINDOW_S, FedArm
from ibrobot_mujoco.parameters import ArmParameters, JointParameters

ARM = "arm"
"""The name of the arm among those of joints, for what all joints share."""
_ERROR_RAD = 0.02
"""Errors of this size count as one; those of more than three times that count less, e.g. where the arm is touched."""
_FADES_S = 0.4
"""What is left out at the beginning of a window, since its first state is measured with noise."""
_RATE_HZ = 34.0
"""More measurements than these tell little more."""
_RESOLUTION_RAD = 0.0005
"""Least error of a measurement: a tick of the servo's encoder is 0.0015 rad."""
_HELD_RAD, _HELD_S, _STILL = 0.15, 0.3, 0.05
"""A gripper that stands so far from its command for so long, slower than so many rad/s, holds an object."""
FIRST_S, _ALL_S = 24.0, 72.0
"""The first steps use so much of the recordings, and the last ones so much [s]: more takes time and tells little."""
_REACHED = 0.002
"""A torque limit shows where the servo would need more for this share of the time."""
_FIRST_STEPS, _LAST_STEPS = 9, 2
_FRICTION = 0.06
"""About the dry friction of a healthy servo [Nm]."""
_SURELY, _CLEARLY = 0.97, 0.9
"""A candidate must have at most this share of the error of the ones before it; so must one that divides lost motion
otherwise between friction and backlash."""
_LOSE_MOTION = ("frictionloss", "backlash")


@attrs.frozen
class Kind:
    """How a parameter is fitted."""

    unit: str
    sigma: float
    """Standard deviation of the prior, of the logarithm if `relative`."""
    step: float
    """How far it is changed for a derivative; likewise."""
    low: float
    high: float
    relative: bool = True
    """Whether its logarithm is fitted."""
    enough: float = 0.0
    """Standard deviation that is good enough, however small the value is."""


KINDS: Mapping[str, Kind] = {
    "kp": Kind("Nm/rad", 1.5, 0.01, 0.2, 5e3),
    "damping": Kind("Nm s/rad", 1.0, 0.01, 1e-3, 1e3, enough=0.03),
    "frictionloss": Kind("Nm", 1.0, 0.02, 1e-3, 1e2, enough=0.01),
    "armature": Kind("kg m^2", 0.08, 0.02, 1e-4, 10.0),
    "torque_limit": Kind("Nm", 0.7, 0.02, 0.02, 1e3),
    "backlash": Kind("rad", 0.03, 0.001, 0.0, 0.5, relative=False, enough=0.003),
    "bias": Kind("rad", 0.05, 0.001, -0.5, 0.5, relative=False, enough=0.003),
}
"""Parameters of a joint."""
SHARED: Mapping[str, Kind] = {
    "delay": Kind("s", 0.05, 0.001, 0.0, 0.5, relative=False, enough=0.002),
    "gravity_compensation": Kind("", 0.3, 0.01, -0.5, 1.5, relative=False, enough=0.1),
}
"""Parameters of the arm."""


@attrs.frozen(eq=False)
class Known:
    """A parameter that was fitted."""

    joint: str
    """The joint, or `ARM`."""
    name: str
    value: float
    deviation: float
    """Its standard deviation, in its unit."""
    prior: float
    """The standard deviation that it had before."""

    @property
    def kind(self) -> Kind:
        """How it was fitted."""
        return (SHARED if self.joint == ARM else KINDS)[self.name]

    @property
    def confidence(self) -> str:
        """`known` within 10 %, `rough` within 30 %, or `unknown`."""
        size = max(abs(self.value), 1e-12)
        if self.deviation <= max(0.1 * size, self.kind.enough) and self.deviation < 0.7 * self.prior:
            return "known"
        if self.deviation <= max(0.3 * size, 2 * self.kind.enough) and self.deviation < 0.7 * self.prior:
            return "rough"
        return "unknown"


@attrs.frozen(eq=False)
class Fitted:
    """The result of a fit."""

    parameters: ArmParameters
    known: tuple[Known, ...]
    needed: Vector
    """Largest torque that each servo needed [Nm], shape (J,)."""
    held: Mapping[str, float] = attrs.field(factory=dict)
    """Gripper -> share of the time in which it held an object, which is left out."""

    def of(self, joint: str, name: str) -> Known:
        """What is known of a parameter."""
        return next(each for each in self.known if (each.joint, each.name) == (joint, name))

    def without(self, joints: Collection[str]) -> Fitted:
        """The same, where nothing is known of these joints."""
        known = (attrs.evolve(each, deviation=each.prior) if each.joint in joints else each for each in self.known)
        return attrs.evolve(self, known=tuple(known))


def rms(errors: Vector) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def error_of(arm: FedArm, parameters: ArmParameters | None, recordings: Sequence[Recording]) -> Vector:
    """Errors of the arm that follows whole recordings from their first state [rad], shape (M, J); as `FedArm.run`."""
    reached = arm.run(parameters, recordings, np.inf)
    return np.concatenate([got - each.measured for got, each in zip(reached, recordings, strict=True)])


class _Problem:
    """Residuals and their derivatives, for SciPy."""

    def __init__(
        self, arm: FedArm, recordings: Sequence[Recording], start: ArmParameters, prior: ArmParameters
    ) -> None:
        self._arm, self._recordings, self.start = arm, recordings, start
        self.joints = arm.robot.joint_names
        self.held = {}
        used = [_used(arm, each) for each in recordings]
        for joint, grips in enumerate(arm.robot.grips):
            if grips:
                holding = [_holding(each, joint) for each in recordings]
                for kept, away in zip(used, holding, strict=True):
                    kept[:, joint] &= ~away
                self.held[self.joints[joint]] = float(np.concatenate(holding).mean())
        self._used = np.concatenate(used)
        self._measured = np.concatenate([each.measured for each in recordings])
        counts = self._used.sum(axis=0)
        ends = np.cumsum(counts)
        self.rows = [slice(int(end - count), int(end)) for end, count in zip(ends, counts, strict=True)]
        self.size = int(ends[-1])
        self.names = [name for name in KINDS if name != "torque_limit" or _limited(start)]
        self.count = len(self.names) * len(self.joints) + len(SHARED)
        self._middle = self.vector(prior)
        kinds = [KINDS[name] for name in self.names for _ in self.joints] + list(SHARED.values())
        self.sigma = np.array([kind.sigma for kind in kinds])
        self.low = np.array([np.log(kind.low) if kind.relative else kind.low for kind in kinds])
        self.high = np.array([np.log(kind.high) if kind.relative else kind.high for kind in kinds])
        self._last: tuple[bytes, Vector] | None = None

    def vector(self, parameters: ArmParameters) -> Vector:
        """The parameters as numbers, shape (count,)."""
        values = []
        for name in self.names:
            kind = KINDS[name]
            for joint in self.joints:
                value = getattr(parameters.joints[joint], name) or 0.0
                inside = min(max(value, kind.low), kind.high)
                values.append(np.log(inside) if kind.relative else inside)
        values += [getattr(parameters, name) or 0.0 for name in SHARED]
        return np.array(values)

    def parameters(self, vector: Vector) -> ArmParameters:
        """The numbers as parameters."""
        rows = vector[: self.count - len(SHARED)].reshape(len(self.names), len(self.joints))
        values = {
            name: np.exp(row) if KINDS[name].relative else row for name, row in zip(self.names, rows, strict=True)
        }
        joints = {
            joint: attrs.evolve(self.start.joints[joint], **{name: float(row[i]) for name, row in values.items()})
            for i, joint in enumerate(self.joints)
        }
        shared = dict(zip(SHARED, vector[self.count - len(SHARED) :].tolist(), strict=True))
        return attrs.evolve(self.start, joints=joints, **shared)

    def errors(self, vector: Vector) -> Vector:
        """Errors that count, joint by joint, as multiples of `_ERROR_RAD`, shape (size,)."""
        key = vector.tobytes()
        if self._last is None or self._last[0] != key:
            reached = np.concatenate(self._arm.run(self.parameters(vector), self._recordings))
            away = (reached - self._measured) / _ERROR_RAD
            self._last = key, np.concatenate([away[kept, i] for i, kept in enumerate(self._used.T)])
        return self._last[1]

    def residuals(self, vector: Vector) -> Vector:
        """Errors, and the distances from the priors, shape (size + count,)."""
        return np.concatenate([self.errors(vector), (vector - self._middle) / self.sigma])

    def slopes(self, vector: Vector, *, both_ways: bool = False) -> Vector:
        """Derivatives of `errors`, shape (size, count); `both_ways` are better, and take twice as long."""
        base = self.errors(vector)
        result = np.zeros((self.size, self.count))
        for row, name in enumerate(self.names):
            columns = slice(row * len(self.joints), (row + 1) * len(self.joints))
            change = self._derived(vector, columns, KINDS[name].step, base, both_ways)
            for i, rows in enumerate(self.rows):
                result[rows, columns.start + i] = change[rows]
        for number, kind in enumerate(SHARED.values(), self.count - len(SHARED)):
            result[:, number] = self._derived(vector, slice(number, number + 1), kind.step, base, both_ways)
        self._last = vector.tobytes(), base
        return result

    def _derived(self, vector: Vector, columns: slice, step: float, base: Vector, both_ways: bool) -> Vector:
        ahead, behind = vector.copy(), vector.copy()
        # All joints change alike, away from the nearer bound.
        ahead[columns] += step
        if (ahead[columns] > self.high[columns]).any():
            ahead[columns] -= 2 * step
        if not both_ways:
            change: Vector = (self.errors(ahead) - base) / (ahead - vector)[columns][0]
            return change
        behind[columns] = np.maximum(vector[columns] - step, self.low[columns])
        ways = (ahead - behind)[columns]
        change = self.errors(ahead) - self.errors(behind)
        if len(ways) == 1:
            change /= ways[0]
            return change
        for rows, way in zip(self.rows, ways, strict=True):
            change[rows] /= way
        return change

    def jacobian(self, vector: Vector) -> Vector:
        """Derivatives of `residuals`."""
        whole: Vector = np.concatenate([self.slopes(vector), np.diag(1 / self.sigma)])
        return whole


def _limited(parameters: ArmParameters) -> bool:
    return all(each.torque_limit is not None for each in parameters.joints.values())


def _used(arm: FedArm, recording: Recording) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
    """The measurements that count, shape (M, J)."""
    every = max(1, int(len(recording.times) / max(recording.seconds, 1e-9) / _RATE_HZ))
    used = np.zeros_like(recording.measured, dtype=bool)
    for window in arm.windows(recording):
        first = window.rows.start
        begin = recording.times[first] + _FADES_S
        used[window.rows][recording.times[window.rows] >= begin] = True
    used[np.arange(len(used)) % every != 0] = False
    return used


def _holding(recording: Recording, joint: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """When a gripper holds an object, shape (M,)."""
    times, measured = recording.times, recording.measured[:, joint]
    newest = np.searchsorted(recording.command_times, times, side="right") - 1
    away = np.abs(recording.commands[np.maximum(newest, 0), joint] - measured)
    speed = np.abs(np.gradient(measured, times))
    stands = (away > _HELD_RAD) & (speed < _STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stands, [False]]).astype(int)))
    holding = np.zeros(len(times), bool)
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        if times[end - 1] - times[begin] >= _HELD_S:
            holding[begin:end] = True
    return holding


def best_start(
    arm: FedArm, recordings: Sequence[Recording], candidates: Sequence[ArmParameters],
    said: Callable[[str], None] = lambda text: None,
) -> ArmParameters:  # fmt: skip
    """For each joint the candidate that is least off; also with weaker servos, which no small step would find."""
    said("the published servo, and others")
    start = _best(arm, recordings, candidates)
    wider = [_scaled(start, "kp", factor) for factor in (1.0, 0.35, 0.6, 1.7, 3.0)]
    start = _best(arm, recordings, wider)
    if _limited(start):
        start = _best(arm, recordings, [_scaled(start, "torque_limit", factor) for factor in (1.0, 0.5, 0.25, 0.12)])
    delays = [attrs.evolve(start, delay=delay) for delay in (0.0, 0.02, 0.05, 0.1)]
    errors = [sum(_error_by_joint(arm, recordings, each)) for each in delays]
    start = delays[int(np.argmin(errors))]
    joints = {name: attrs.evolve(each, backlash=max(each.backlash, 0.004)) for name, each in start.joints.items()}
    return attrs.evolve(start, joints=joints)


def _scaled(parameters: ArmParameters, name: str, factor: float) -> ArmParameters:
    joints = {
        joint: attrs.evolve(each, **{name: getattr(each, name) * factor}) for joint, each in parameters.joints.items()
    }
    return attrs.evolve(parameters, joints=joints)


def _error_by_joint(arm: FedArm, recordings: Sequence[Recording], parameters: ArmParameters) -> list[float]:
    reached = np.concatenate(arm.run(parameters, recordings, WINDOW_S))
    away = np.abs(reached - np.concatenate([each.measured for each in recordings]))
    return [float(np.minimum(column, 5 * _ERROR_RAD).mean()) for column in away.T]


def _best(
    arm: FedArm, recordings: Sequence[Recording], candidates: Sequence[ArmParameters], share: float = _SURELY
) -> ArmParameters:
    """For each joint a candidate, unless a later one has less than this share of its error."""
    errors = np.array([_error_by_joint(arm, recordings, each) for each in candidates])
    chosen: dict[str, JointParameters] = {}
    for i, joint in enumerate(arm.robot.joint_names):
        best = 0
        for number, error in enumerate(errors[:, i]):
            if error < share * errors[best, i]:
                best = number
        chosen[joint] = candidates[best].joints[joint]
    return attrs.evolve(candidates[0], joints=chosen)


def some(recordings: Sequence[Recording], seconds: float) -> list[Recording]:
    """Windows of the recordings, evenly over them, which are together about so long [s]."""
    total = sum(each.seconds for each in recordings)
    if total <= seconds:
        return list(recordings)
    windows = []
    for each in recordings:
        count = max(1, round(each.seconds / WINDOW_S))
        edges = np.linspace(0, each.seconds + 1e-6, count + 1)
        windows += [each.cut(float(begin), float(end)) for begin, end in pairwise(edges)]
    wanted = max(1, round(len(windows) * seconds / total))
    return [windows[i] for i in np.linspace(0, len(windows) - 1, wanted).round().astype(int)]


def fit(
    arm: FedArm, recordings: Sequence[Recording], start: ArmParameters, prior: ArmParameters,
    said: Callable[[str], None] = lambda text: None,
) -> ArmParameters:  # fmt: skip
    """Fit the parameters.

    Args:
        arm: the arm.
        recordings: of it.
        start: where to begin.
        prior: around which the priors are.
        said: receives what is done.
    """
    first = some(recordings, FIRST_S)
    start = _stepped(_Problem(arm, first, start, prior), _FIRST_STEPS, said)[0]
    exchanged = _exchanged(arm, first, start)
    if exchanged != start:
        start = _stepped(_Problem(arm, first, exchanged, prior), _FIRST_STEPS // 2, said)[0]
    return _stepped(_Problem(arm, some(recordings, _ALL_S), start, prior), _LAST_STEPS, said)[0]


def _exchanged(arm: FedArm, recordings: Sequence[Recording], start: ArmParameters) -> ArmParameters:
    """For each joint friction alone, unless it is worse; both lose motion, and a fit may end with the wrong one."""
    by_friction, by_backlash, _ = _splits(start)
    return _best(arm, recordings, [by_friction, start, by_backlash], _CLEARLY)


def _splits(parameters: ArmParameters) -> tuple[ArmParameters, ArmParameters, ArmParameters]:
    """The same lost motion of each joint by friction alone, with a healthy servo's friction, and with half its own."""
    alone: dict[str, JointParameters] = {}
    healthy: dict[str, JointParameters] = {}
    half: dict[str, JointParameters] = {}
    for name, each in parameters.joints.items():
        lost = each.backlash + 2 * each.frictionloss / each.kp
        alone[name] = attrs.evolve(each, frictionloss=lost * each.kp / 2, backlash=0.0)
        for others, friction in ((healthy, min(each.frictionloss, _FRICTION)), (half, each.frictionloss / 2)):
            others[name] = attrs.evolve(each, frictionloss=friction, backlash=lost - 2 * friction / each.kp)
    by_friction, by_backlash, by_both = (attrs.evolve(parameters, joints=joints) for joints in (alone, healthy, half))
    return by_friction, by_backlash, by_both


def _undivided(arm: FedArm, recordings: Sequence[Recording], parameters: ArmParameters) -> dict[tuple[str, str], float]:
    """How far friction and backlash of a joint are from other values, in their units, that fit as well."""
    errors = _error_by_joint(arm, recordings, parameters)
    away: dict[tuple[str, str], float] = {}
    for other in _splits(parameters):
        others = _error_by_joint(arm, recordings, other)
        for (name, each), error, its in zip(parameters.joints.items(), errors, others, strict=True):
            for what in _LOSE_MOTION if its < error / _SURELY else ():
                difference = abs(getattr(other.joints[name], what) - getattr(each, what))
                away[name, what] = max(difference, away.get((name, what), 0.0))
    return away


def refit(
    arm: FedArm, recordings: Sequence[Recording], start: ArmParameters, prior: ArmParameters,
    said: Callable[[str], None] = lambda text: None,
) -> Fitted:  # fmt: skip
    """Fit the parameters from a fit of similar recordings, and find how well each is known; as `fit`."""
    parts = some(recordings, _ALL_S)
    begin = _best(arm, parts, [start, *_splits(start)], _CLEARLY)
    problem = _Problem(arm, parts, begin, prior)
    parameters, vector = _stepped(problem, _LAST_STEPS if begin == start else _FIRST_STEPS // 2, said)
    said("how well each is known")
    needed, beyond = arm.torques(parameters, recordings)
    unreached = {(each, "torque_limit") for each, share in zip(problem.joints, beyond, strict=True) if share < _REACHED}
    least = _undivided(arm, parts, parameters)
    known = [
        attrs.evolve(each, deviation=each.prior if place in unreached else max(each.deviation, least.get(place, 0.0)))
        for each in _known(problem, vector, _deviations(problem, vector))
        for place in [(each.joint, each.name)]
    ]
    return Fitted(parameters, tuple(known), needed, problem.held)


def _stepped(problem: _Problem, most: int, said: Callable[[str], None]) -> tuple[ArmParameters, Vector]:
    """Up to so many steps of the fit: the parameters, and the same as numbers."""
    steps = 0

    def jacobian(vector: Vector) -> Vector:
        nonlocal steps
        steps += 1
        said(f"step {steps} of at most {most}: {rms(problem.errors(vector)) * np.rad2deg(_ERROR_RAD):.3f} deg rms")
        return problem.jacobian(vector)

    room = 1e-6
    begin = np.clip(problem.vector(problem.start), problem.low + room, problem.high - room)
    result = least_squares(
        problem.residuals, begin, jac=jacobian, bounds=(problem.low, problem.high), x_scale=problem.sigma,
        loss="soft_l1", f_scale=3.0, max_nfev=most, xtol=1e-3, ftol=2e-3, gtol=1e-6,
    )  # fmt: skip
    return problem.parameters(result.x), result.x


def _deviations(problem: _Problem, vector: Vector) -> Vector:
    """Standard deviations, shape (count,): from the errors that are left, if independent, and the priors."""
    slopes, errors = problem.slopes(vector, both_ways=True), problem.errors(vector)
    information = np.diag(1 / problem.sigma**2)
    for rows in problem.rows:
        left = errors[rows]
        variance = max(float(np.mean(left**2)), (_RESOLUTION_RAD / _ERROR_RAD) ** 2) * _correlated(left)
        information += slopes[rows].T @ slopes[rows] / variance
    covariance = np.linalg.inv(information)
    result: Vector = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return result


def _correlated(errors: Vector) -> float:
    """Of how many errors in sequence one is independent."""
    centred = errors - errors.mean()
    power = float(centred @ centred)
    if power <= 0 or len(centred) < 8:
        return 1.0
    total = 1.0
    for lag in range(1, min(len(centred) // 4, 400)):
        correlation = float(centred[lag:] @ centred[:-lag]) / power
        if correlation <= 0.05:
            break
        total += 2 * correlation
    return total


def _known(problem: _Problem, vector: Vector, deviations: Vector) -> list[Known]:
    known = []
    places = [(joint, name) for name in problem.names for joint in problem.joints] + [(ARM, name) for name in SHARED]
    for (joint, name), value, deviation, sigma in zip(places, vector, deviations, problem.sigma, strict=True):
        kind = (SHARED if joint == ARM else KINDS)[name]
        number = float(np.exp(value)) if kind.relative else float(value)
        scale = number if kind.relative else 1.0
        known.append(Known(joint, name, number, float(deviation) * scale, float(sigma) * scale))
    return known
