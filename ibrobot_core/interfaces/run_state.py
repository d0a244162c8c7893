"""What a run tells of itself: states of control, measurements of its parts, and its outcome."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import MissingDependency
from ibrobot_core.interfaces.engine import EngineStats
from ibrobot_core.interfaces.teleop import Teleop
from ibrobot_core.robot import Vector


@attrs.frozen(eq=False)
class ControlState:
    """The state of the control loop after a tick; arrays in robot order."""

    tick: int
    stamp_ns: int
    late_ns: int
    """Delay of the tick's start [ns]."""
    generation: int
    """Counts mode switches and resets; plans from an earlier generation are not followed."""
    estop: bool
    stale: bool
    """Whether the reading repeats an earlier one."""
    success: bool | None
    position: Vector
    velocity: Vector
    effort: Vector
    command: Vector
    """Command written to the hardware [rad], shape (J,)."""
    signals: Vector
    """All hardware signals, concatenated, shape (S,)."""
    stops: int = 0
    """Number of emergency stops since the run began, also of those pressed while one was latched."""


@attrs.frozen(eq=False)
class PlanRecord:
    """Timed setpoints for the joints in `mask`; executors without joints in it brake."""

    generation: int
    start_ns: int
    step_ns: int
    mask: NDArray[np.bool_]
    """Shape (J,)."""
    positions: Vector
    """Setpoints [rad], shape (N, J); columns outside the mask are ignored."""


class StateWatch:
    """Waits for states of control; made by `RunView.watch_states`.

    Args:
        newest: returns the newest state.
        new_state: notified at each state.
    """

    def __init__(self, newest: Callable[[], ControlState | None], new_state: threading.Condition) -> None:
        self._newest, self._new_state = newest, new_state
        self._seen = newest()

    def get(self, timeout_s: float = 0.0) -> ControlState | None:
        """The newest state, if it has not been returned yet; None if none comes within `timeout_s` [s]."""
        with self._new_state:
            if not self._new_state.wait_for(lambda: self._newest() is not self._seen, timeout_s):
                return None
            self._seen = self._newest()
            return self._seen


@attrs.define
class Outcome:
    """The outcome of a run."""

    episodes: int = 0
    successes: int = 0
    unjudged: int = 0
    """Number of kept episodes that nobody judged."""
    disturbed: int = 0
    """Number of episodes during which a fault or an emergency stop occurred."""
    faults: list[str] = attrs.field(factory=list)
    goals_failed: int = 0
    holding: list[str] = attrs.field(factory=list)
    """One line for each part that holds torque after the run, with the command that switches it off."""


@attrs.define
class DispatchStats:
    """Counters and timings for diagnostics."""

    strategy: str = "ensemble"
    smoothing: bool = True
    """Whether chunks blend."""
    plan_length: int = 0
    """Actions left in the plan."""
    watermark: int = 0
    """Plan length at which the next chunk is requested."""
    latency_ms: float = 0.0
    """Time from the observation to the arrival of its chunk, for the last chunk."""
    latency_p50_ms: float = 0.0
    """Median of the recent latencies."""
    latency_p99_ms: float = 0.0
    queue_ms: float = 0.0
    """The part of the last latency that the request spent queued behind other robots."""
    pace_ms: float = 0.0
    """Minimum time between requests, set by the model's server; 0 for no minimum."""
    requests: int = 0
    retries: int = 0
    """Requests sent because the previous one was overdue."""
    chunks: int = 0
    late_chunks: int = 0
    """Chunks that were entirely in the past on arrival."""
    dropped_answers: int = 0
    """Answers to requests that had timed out, been overtaken by a newer answer, or preceded a reset."""
    failures: int = 0
    """Requests without a chunk, including timeouts; all requests in flight during one outage count as one."""
    timeouts: int = 0
    unreachable: int = 0
    """Actions that no position of the joints gives; the one before is held instead."""
    holds: int = 0
    """Times the plan ran dry."""


@attrs.frozen
class ActingPolicy:
    """The policy that moves the robot in a mode with inference."""

    dispatch: DispatchStats
    engine: EngineStats
    described: Callable[[], Mapping[str, str]]
    """Name and weights of the policy."""


@attrs.define
class SensorFigures:
    """Measurements of a sensor's messages."""

    received: int
    """Number of messages so far."""
    rate_hz: float
    age_s: float | None
    """Age of the newest message at publication, by its stamp [s]; None for messages without a stamp."""


@attrs.frozen
class AbsentSensor:
    """A peripheral that cannot run on this machine."""

    name: str
    label: str
    """Kind and name, e.g. `camera top`."""
    topic: str
    """The topic of its messages."""
    missing: MissingDependency


class SharedDevices:
    """The open teleoperation devices of a run, with the number of their users. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: dict[Hashable, tuple[Teleop, int]] = {}

    def take(self, key: Hashable, opened: Callable[[], Teleop]) -> Teleop:
        """The device with this key, made by `opened` unless it is open already."""
        with self._lock:
            device, users = self._open.get(key) or (opened(), 0)
            self._open[key] = device, users + 1
            return device

    def give_back(self, key: Hashable) -> bool:
        """End a use of a device; return whether it was the last one."""
        with self._lock:
            device, users = self._open.pop(key)
            if users > 1:
                self._open[key] = device, users - 1
            return users == 1
