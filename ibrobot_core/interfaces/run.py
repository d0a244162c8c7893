"""Views of a run, one for each thing that a part of it may do; `launch.session.Session`, behind all, documents them.

A part takes the narrowest view that it works with. Only `StreamingRun` and `GoalRun` move the robot.
"""

# ruff: noqa: D102

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any, ClassVar, Protocol

import attrs

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.interfaces import run_state
from ibrobot_core.interfaces.executor import ExecutorGoal
from ibrobot_core.interfaces.hardware import JointReading
from ibrobot_core.interfaces.teleop import OperatorEvent
from ibrobot_core.pulses import Pulse
from ibrobot_core.robot import Vector
from ibrobot_core.run_hooks import Told
from ibrobot_core.schema import ControlMode, RobotConfig


class CommandSource(Told):
    """Commands the active executors of a mode, from `begin` to `end`. The base class sends nothing.

    Attributes:
        autonomous: whether it moves the robot without an operator. Such a source does not start again after a reset
            until the operator enters the mode.
    """

    autonomous = False

    def begin(self, seed: int) -> None:
        """Start; called when the mode is entered and after a reset."""

    def end(self) -> None:
        """Stop; called when the mode is left."""

    def recover(self) -> None:
        """Recover from a failure; called before a reset.

        Raises:
            IbrobotError: if it cannot recover; the fault stays.
        """

    def described(self) -> Mapping[str, str] | None:
        """Name and weights of the policy that it runs; None without one."""
        return None


@attrs.frozen
class LaunchRequest:
    """The user's request for a run: the options of `ibrobot launch`."""

    lockstep: bool = False
    """Whether time is simulated, and advances once all work of a tick is done."""
    seed: int = 0
    """Seed of the first episode; each later episode adds 1."""
    duration_s: float | None = None
    """Duration of the run [s]; None for a run without a time limit."""
    episodes: int | None = None
    """Number of episodes after which the run ends."""
    goals: tuple[str, ...] = ()
    """Goals for a mode with a planner, in the syntax of `--goal`."""
    keys: Callable[[], Any] | None = None
    """Subscribes to the keys of the terminal."""
    prompt: str = ""
    """Prompt of recorded episodes."""
    by_operator: bool = False
    """Whether an operator begins and ends episodes, instead of the mode."""
    source: Callable[[StreamingRun, ControlMode], CommandSource] | None = None
    """Makes the command source of the first mode, in place of the one in the YAML."""


class Plugins(Protocol):
    """The installed plugins, as parts of a run ask for them: of `Registry`, which documents it."""

    @property
    def readers(self) -> Sequence[Any]: ...
    def find(self, kind: str, type_: str) -> Any: ...
    def create(self, kind: str, type_: str, *arguments: Any) -> Any: ...
    def of_kind(self, kind: str) -> Sequence[Any]: ...
    def sections(self, config: RobotConfig) -> Iterator[tuple[Any, Any]]: ...
    def open_episode(self, path: Any) -> Any: ...
    def versions(self) -> Mapping[str, str]: ...
    def build_policy(self, config: RobotConfig, name: str, seed: int = 0) -> Any: ...


class MotionScope:
    """Limits of all motion. This one is that without agents; `ibrobot_terminal.authority` has that of a grant."""

    acting: ClassVar[ContextVar[Any]] = ContextVar("acting agent", default=None)
    """The agent for which the present thread works; None for a person."""
    speed = 1.0
    """Fraction of the velocity limits that motions must keep to now."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self.lock = threading.RLock()
        """Held while the scope changes and goals are sent; never while another lock is taken."""

    @property
    def grant(self) -> Any:
        """What an agent is granted now; None without a grant."""
        return None

    def taken_over(self, what: str, policy: bool = False) -> None:
        """Note that the mode is entered or reset; `policy`: that it starts a policy. Refuses what is not granted."""

    def check_path(self, positions: Vector, fastest: float) -> None:
        """Check the path of a goal, positions of all joints [rad], shape (N, J), at a fraction of the speed limits."""

    def admits_plan(self, joints: tuple[str, ...], positions: Vector) -> bool:
        """Whether a plan may be sent now."""
        return not self._session.held


class RunView(Protocol):
    """A run, for parts that show it, publish what it does, or serve others: they read it, and may stop and end it."""

    @property
    def config(self) -> RobotConfig: ...
    @property
    def registry(self) -> Plugins: ...
    @property
    def request(self) -> LaunchRequest: ...
    @property
    def clock(self) -> Clock: ...
    @property
    def bus(self) -> Bus: ...
    @property
    def log(self) -> logging.Logger: ...
    @property
    def mode(self) -> str: ...
    @property
    def generation(self) -> int: ...
    @property
    def factors(self) -> Mapping[str, float]: ...
    @property
    def state(self) -> run_state.ControlState | None: ...
    @property
    def on_state(self) -> list[Callable[[run_state.ControlState], None]]: ...
    @property
    def on_goal(self) -> list[Callable[[Mapping[str, Any]], None]]: ...
    @property
    def signals(self) -> Sequence[tuple[str, int]]: ...
    @property
    def conditions(self) -> Sequence[Mapping[str, Any]]: ...
    @property
    def stops(self) -> int: ...

    @property
    def authority(self) -> MotionScope: ...

    @property
    def stopped_by(self) -> str: ...
    @property
    def faults(self) -> tuple[str, ...]: ...
    @property
    def held(self) -> bool: ...
    @property
    def plan(self) -> run_state.PlanRecord | None: ...
    @property
    def acting(self) -> run_state.ActingPolicy | None: ...
    @property
    def commander(self) -> str: ...
    @property
    def followed_ns(self) -> int: ...
    @property
    def command_source(self) -> CommandSource: ...
    @property
    def simulates_episodes(self) -> bool: ...
    @property
    def sensors(self) -> Mapping[str, run_state.SensorFigures]: ...
    @property
    def absent(self) -> tuple[run_state.AbsentSensor, ...]: ...
    @property
    def outcome(self) -> run_state.Outcome: ...
    @property
    def failure_text(self) -> str: ...
    @property
    def finished(self) -> threading.Event: ...
    @property
    def pulses(self) -> set[Pulse]: ...
    def measured(self) -> JointReading: ...
    def watch_states(self) -> run_state.StateWatch: ...
    def counts(self) -> dict[str, Mapping[str, Any]]: ...
    def to_go_on(self) -> str: ...
    def make(self, kind: str, component: ComponentConfig, name: str, **more: Any) -> Any: ...
    def refuse_absent(self, user: str, needs: Callable[[str], bool]) -> None: ...
    def change_world(self, change: Mapping[str, Any]) -> None: ...
    def emergency_stop(self) -> None: ...
    def check_stop(self) -> None: ...
    def finish(self) -> None: ...
    def fail(self, component: str, error: BaseException) -> None: ...


class StreamingRun(RunView, Protocol):
    """A run, for sources of setpoints: they send plans, and have the robot hold if that fails."""

    commander: str
    followed_ns: int

    @property
    def devices(self) -> run_state.SharedDevices: ...
    def send_plan(self, start_ns: int, step_ns: int, joints: tuple[str, ...], positions: Vector) -> None: ...
    def reset_episode(self, seed: int) -> bool: ...
    def end_episode(self, outcome: str) -> None: ...
    def raise_fault(self, fault: str) -> None: ...
    def pass_on(self, event: OperatorEvent) -> None: ...


class GoalRun(RunView, Protocol):
    """A run, for clients with goals: they send them through the door, and cancel them."""

    def send_goal(self, executor: str, goal_id: str, goal: ExecutorGoal, stops: int | None = None) -> None: ...
    def cancel_goals(self, executor: str = "") -> None: ...


class GuardedRun(GoalRun, Protocol):
    """A run, for the door that checks the goals of all clients."""

    goal_door: Callable[[str, str, ExecutorGoal, Callable[[ExecutorGoal], None]], None] | None


class RecordedRun(RunView, Protocol):
    """A run, for what begins, ends and records its episodes."""

    @property
    def operator_events(self) -> queue.SimpleQueue[OperatorEvent]: ...
    def begin_source(self) -> None: ...
    def end_source(self) -> None: ...
    def add_fault(self, fault: str, generation: int | None = None) -> None: ...
    def emit(self, event: str, **facts: Any) -> None: ...


class RunAccess(StreamingRun, GuardedRun, RecordedRun, Protocol):
    """A run, for makers of its parts, which give each the view that it needs."""
