"""Replay: sends control the commands of a recorded episode, after a slow approach to the first."""

from __future__ import annotations

from typing import Any, override

import numpy as np

from ibrobot_core.api import NS_PER_S, HardwareError, Vector, ns, seconds
from ibrobot_core.app import ControlMode, ControlState, SourceWorker, StreamingRun
from ibrobot_data.playback import Playback, Track

_APPROACH_SPEED = 0.5
"""Maximum speed of the approach to the first command [rad/s]; `max_velocity` also limits it."""
_PEAK_SPEED, _PEAK_ACCELERATION = 1.5, 6.0
"""Maximum first and second derivative of `_ease`."""
_AHEAD_NS = NS_PER_S
"""Duration of the motion that one plan covers [ns]."""
_SETTLE_NS = NS_PER_S
"""Maximum time from the last command to the success of the scene, if the recording succeeded [ns]."""


class ReplaySource(SourceWorker):
    """Plays an episode once, and ends the run. Its commands pass through executors and safety, as those of a teleop.

    In simulation the recorded seed sets up the scene first. A fault ends the replay.

    Args:
        session: the run.
        mode: the mode of the replay.
        episode: the episode's name on the command line.
        playback: its motion.
        speed: seconds of the recording that are played per second.
    """

    session: StreamingRun
    autonomous = True
    urgent = True

    def __init__(
        self, session: StreamingRun, mode: ControlMode, episode: str, playback: Playback, speed: float
    ) -> None:
        super().__init__(session, mode, f"{episode}, {playback.duration / speed:.1f} s")
        self._episode, self._playback, self._speed = episode, playback, speed
        self._period_ns = ns(1.0 / session.config.control.rate_hz)
        self._columns = session.config.robot.indices(playback.joints)
        self._begun_ns: int | None = None
        """When the approach began [ns]; None before."""
        self._rows: Vector = np.empty((0, 0))
        """One setpoint for each control period since then [rad], shape (N, J)."""
        self._approach_ns = 0
        self._sent = 0
        """Number of rows sent to control."""
        self._measured: list[tuple[int, Vector]] = []
        self._success: bool | None = None

    @override
    def setup(self) -> None:
        self._states = self.session.watch_states()

    @override
    def begin_mode(self, seed: int) -> None:
        self._begun_ns, self._measured, self._success = None, [], None
        recorded = self._playback.seed
        if not self.session.config.simulated or recorded is None:
            return
        if not self.session.reset_episode(recorded):
            raise HardwareError("the replay cannot begin: reset the emergency stop first")

    @override
    def work(self, timeout_s: float) -> None:
        if self._states.get(timeout_s) is None:
            return
        with self.lock:
            session, state = self.session, self.session.state
            if not self.active or state is None:
                return
            if session.outcome.faults:
                self.active = False
                session.finish()
            elif state.generation == session.generation:
                self._follow(state)

    def _follow(self, state: ControlState) -> None:
        if self._begun_ns is None:
            self._begun_ns, self._sent = state.stamp_ns, 0
            self._rows = self._setpoints(state.position[self._columns])
        elapsed_ns = state.stamp_ns - self._begun_ns
        here, ahead = elapsed_ns // self._period_ns, _AHEAD_NS // self._period_ns
        if 0 < self._sent <= here and self._sent < len(self._rows):
            # This side was delayed until control had no setpoints left: continue where control holds, and skip none.
            pause_ns = (here - self._sent + 1) * self._period_ns
            self._begun_ns += pause_ns
            elapsed_ns -= pause_ns
            here = self._sent - 1
        if not state.stale and elapsed_ns >= self._approach_ns:
            self._measured.append((elapsed_ns - self._approach_ns, state.position[self._columns]))
        if self._sent < min(here + ahead // 2, len(self._rows)):
            rows = self._rows[here : here + ahead]
            if len(rows):
                start_ns = self._begun_ns + here * self._period_ns
                self.session.send_plan(start_ns, self._period_ns, self._playback.joints, rows)
            self._sent = here + len(rows)
        if state.success is not None:
            self._success = bool(self._success or state.success)
        self._end_when_done(elapsed_ns - (len(self._rows) - 1) * self._period_ns)

    def _setpoints(self, begin: Vector) -> Vector:
        """The approach from `begin` [rad], shape (J,), and the commands, one row for each control period."""
        playback, session = self._playback, self.session
        away = playback.commands.positions[0] - begin
        robot = session.config.robot
        speed = np.minimum(_APPROACH_SPEED, robot.max_velocity[self._columns])
        acceleration = 0.5 * robot.max_acceleration[self._columns]
        by_speed = _PEAK_SPEED * np.abs(away) / speed
        by_acceleration = np.sqrt(_PEAK_ACCELERATION * np.abs(away) / acceleration)
        steps = int(np.ceil(max(by_speed.max(), by_acceleration.max()) * session.config.control.rate_hz))
        self._approach_ns = steps * self._period_ns
        approach = begin + _ease(np.arange(steps) / max(steps, 1))[:, None] * away
        period_s = seconds(self._period_ns) * self._speed
        played: Vector = np.arange(np.ceil(playback.duration / period_s) + 1) * period_s
        return np.concatenate([approach, playback.commands.at(played)])

    def _end_when_done(self, late_ns: int) -> None:
        """End the run, `late_ns` [ns] after the last setpoint was due."""
        session = self.session
        provisional = session.config.simulated and self._playback.outcome == "success" and self._success is False
        if late_ns < (_SETTLE_NS if provisional else 0):
            return
        self.active = False
        if self._success is not None and self._playback.outcome == "success":
            session.end_episode("success" if self._success else "failure")
        session.finish()

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        report = self.report()
        rows = [("replayed", f"{report['source']}, {report['recorded_s']:.1f} s at speed {report['speed']:g}")]
        if report["success"] is not None:
            again = "success" if report["success"] else "no success"
            rows.append(("scene", f"{again}; recorded: {report['recorded_outcome']}"))
        if not report["tracking"]:
            rows.append(("tracking", "nothing to compare"))
        for joint, away in report["tracking"].items():
            off = f"rms {away['rms_rad']:.4f} rad, max {away['max_rad']:.4f} rad off the recording"
            rows.append(("tracking", f"{joint:14} {off}"))
        return rows

    @override
    def facts(self) -> dict[str, Any]:
        return {"replay": self.report()}

    def report(self) -> dict[str, Any]:
        """The result, as JSON values."""
        tracking = {}
        if self._measured:
            times = np.array([elapsed_ns for elapsed_ns, _ in self._measured]) / NS_PER_S * self._speed
            tracking = self._playback.tracking(Track(times, np.stack([position for _, position in self._measured])))
        return {
            "source": self._episode,
            "speed": self._speed,
            "recorded_s": round(self._playback.duration, 3),
            "recorded_outcome": self._playback.outcome,
            "success": self._success,
            "tracking": tracking,
        }

    @override
    def help(self) -> str:
        return f"replays {self._episode}; Esc stops"


def _ease(share: Vector) -> Vector:
    """A smooth ramp from 0 to 1, at rest at both ends."""
    eased: Vector = share * share * (3 - 2 * share)
    return eased
