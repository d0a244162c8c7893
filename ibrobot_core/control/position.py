"""The `position` executor: follows a plan of timed setpoints and reports when the plan has run dry."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, override

import numpy as np

from ibrobot_core.control.spline import Spline, smooth_velocities
from ibrobot_core.descriptors import StreamOptions
from ibrobot_core.interfaces import Context, Executor, JointReading, Plan
from ibrobot_core.robot import FARTHEST, Vector
from ibrobot_core.units import ns, seconds


class PositionExecutor(Executor):
    """Follows the setpoints of its plan with continuous acceleration; a plan of length one is a teleop command.

    Between setpoints it follows a cubic spline, which stays within the joint limits if the setpoints do. A plan that
    has already begun is joined within one step, without a jump in position or speed. Until one step before the first
    setpoint the executor holds; it moves there during that step. After the last setpoint it holds that setpoint. Once
    the setpoint is older than `stale_timeout`, the plan is stale and `safety_behavior` applies: `hold` brakes at once,
    `relax` requests torque off until a new plan arrives.
    """

    accepts_plans: ClassVar[bool] = True

    def __init__(self, options: StreamOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        columns = ctx.robot.indices(ctx.joints)
        self._lower, self._upper = ctx.robot.lower[columns], ctx.robot.upper[columns]
        self._stale_ns = ns(options.stale_timeout)
        self._relaxes = options.safety_behavior == "relax"
        self._log = ctx.log
        self._counters = {"stale": 0, "refused_shape": 0, "refused_nonfinite": 0, "refused_step": 0}
        self._setpoint: Vector = np.full(len(self.joints), np.nan)
        self._velocity: Vector = np.zeros(len(self.joints))
        self._stamp_ns = 0
        self._plan: Plan | None = None
        self._curve: Spline | None = None
        self._joining: Vector | None = None
        """Offset from the plan, and of the speed times a step, when the plan arrived; shape (2, J)."""
        self._joined_at_ns = 0
        self._lowest = self._highest = self._setpoint
        self._approach_ns = 0
        self._approach_from = self._setpoint
        self._stale = False

    @override
    def activate(self, measured: JointReading) -> None:
        self.deactivate()
        self._setpoint = measured.position.copy()
        self._velocity = np.zeros(len(self.joints))
        self._stamp_ns = measured.stamp_ns

    @override
    def deactivate(self) -> None:
        self._plan = None
        self._stale = False

    @override
    def set_plan(self, plan: Plan) -> None:
        """Replace the plan; one that is not (N, J) positions within `FARTHEST` with a positive step is only counted."""
        try:
            positions = np.array(plan.positions, dtype=np.float64)
        except (TypeError, ValueError):
            positions = np.empty(0)
        if positions.ndim != 2 or positions.shape[0] == 0 or positions.shape[1] != len(self.joints):
            self._refuse("refused_shape", f"shape {positions.shape}, not (N, {len(self.joints)})")
        elif not (np.abs(positions) <= FARTHEST).all():
            self._refuse("refused_nonfinite", f"values that are not finite, or beyond {FARTHEST:g}")
        elif plan.step_ns <= 0:
            self._refuse("refused_step", f"step_ns {plan.step_ns}, which must be above 0")
        else:
            self._plan = Plan(start_ns=plan.start_ns, step_ns=plan.step_ns, positions=positions)
            self._approach_ns = max(self._stamp_ns, plan.start_ns - plan.step_ns)
            self._approach_from = self._setpoint
            self._curve = _curve(self._plan) if len(positions) > 1 else None
            # A spline overshoots its points slightly.
            self._lowest = np.minimum(self._lower, positions.min(axis=0))
            self._highest = np.maximum(self._upper, positions.max(axis=0))
            self._join()
            self._stale = False

    @override
    def update(self, measured: JointReading) -> Vector:
        now_ns, before_ns, before = measured.stamp_ns, self._stamp_ns, self._setpoint
        self._stamp_ns = now_ns
        if (plan := self._plan) is not None:
            last_ns = plan.start_ns + (len(plan.positions) - 1) * plan.step_ns
            if now_ns - last_ns >= self._stale_ns:
                self._plan = None
                self._stale = True
                self._counters["stale"] += 1
            else:
                self._setpoint = self._at(plan, now_ns)
        if self.wants_relax:
            # The arm falls: the next plan starts from the measured position.
            self._setpoint = np.where(np.isfinite(measured.position), measured.position, self._setpoint)
        if now_ns > before_ns:
            self._velocity = (self._setpoint - before) / seconds(now_ns - before_ns)
        return self._setpoint.copy()

    @property
    @override
    def wants_relax(self) -> bool:
        """Whether torque should be off: the plan is stale and `safety_behavior` is `relax`."""
        return self._stale and self._relaxes

    @property
    @override
    def is_stale(self) -> bool:
        return self._stale and not self._relaxes

    @override
    def counters(self) -> Mapping[str, int]:
        """`stale`: number of plans that ran dry; `refused_*`: number of plans refused."""
        return dict(self._counters)

    def _at(self, plan: Plan, now_ns: int) -> Vector:
        """The plan's setpoint [rad] at `now_ns`, shape (J,)."""
        if now_ns < plan.start_ns:
            done = max(0, now_ns - self._approach_ns) / (plan.start_ns - self._approach_ns)
            approached: Vector = self._approach_from + done * (plan.positions[0] - self._approach_from)
            return approached
        if self._curve is None:
            only: Vector = plan.positions[0]
            return only
        setpoint = np.clip(self._curve.at(now_ns)[0], self._lowest, self._highest)
        share = (now_ns - self._joined_at_ns) / plan.step_ns
        if self._joining is not None and share < 1.0:
            gap, lag = self._joining
            setpoint += (1 - share**2 * (3 - 2 * share)) * gap + share * (1 - share) ** 2 * lag
        return setpoint

    def _join(self) -> None:
        """Store the offset of the last output from the plan, which then fades out over a step."""
        plan, curve = self._plan, self._curve
        self._joining = None
        if plan is not None and curve is not None and plan.start_ns <= self._stamp_ns:
            position, velocity, _ = curve.at(self._stamp_ns)
            lag = (self._velocity - velocity) * seconds(plan.step_ns)
            self._joining = np.array((self._setpoint - np.clip(position, self._lowest, self._highest), lag))
            self._joined_at_ns = self._stamp_ns

    def _refuse(self, counter: str, why: str) -> None:
        self._counters[counter] += 1
        if self._counters[counter] == 1:
            self._log.warning("refused a plan: %s; further ones are counted as %s", why, counter)


def _curve(plan: Plan) -> Spline:
    times_ns = plan.start_ns + plan.step_ns * np.arange(len(plan.positions))
    return Spline(times_ns, plan.positions, smooth_velocities(plan.positions, seconds(plan.step_ns)))
