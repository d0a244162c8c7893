"""A run's shared state: config, clock, bus, control, faults, and the mode that is active."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import attrs
import numpy as np

from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock, RealClock, SteppedClock
from ibrobot_core.component import Worker, error_line
from ibrobot_core.config import RobotConfig
from ibrobot_core.config.schema import ComponentConfig, ControlMode
from ibrobot_core.control.link import ControlState, PlanRecord
from ibrobot_core.errors import ComponentFailed
from ibrobot_core.interfaces import Context, EngineStats, JointReading, OperatorEvent
from ibrobot_core.launch.absence import AbsentSensor, absent_sensors, refuse
from ibrobot_core.plugins import Registry
from ibrobot_core.robot import Vector

if TYPE_CHECKING:
    from ibrobot_core.control.host import ControlHost
    from ibrobot_core.dispatch.dispatcher import DispatchStats
    from ibrobot_core.launch.sources.source_worker import SourceWorker


@attrs.frozen
class LaunchRequest:
    """What a user asks of a run; the options of `ibrobot launch`."""

    lockstep: bool = False
    """Whether time is simulated, and advances when all work of a tick is done."""
    seed: int = 0
    """Of the first episode; later ones count up."""
    duration_s: float | None = None
    """When the run ends [s]; None: it ends by itself, or when the user ends it."""
    episodes: int | None = None
    """After how many episodes the run ends."""
    goals: tuple[str, ...] = ()
    """For a mode with a planner, as `--goal` takes them."""
    keys: Callable[[], Any] | None = None
    """Subscribes to the keys of the terminal, e.g. `KeyReader.subscribe`."""
    prompt: str = ""
    """What episodes are recorded under."""
    by_operator: bool = False
    """Whether an operator begins and ends episodes, rather than the mode."""
    source: Callable[[Session, ControlMode], SourceWorker] | None = None
    """Makes the command source of the mode in which the run begins, in place of the one that the YAML says."""


@attrs.define
class Outcome:
    """What came of a run."""

    episodes: int = 0
    successes: int = 0
    faults: list[str] = attrs.field(factory=list)
    goals_failed: int = 0
    holding: list[str] = attrs.field(factory=list)
    """What holds torque after the run, and how to take it off, a line each."""


@attrs.frozen
class ActingPolicy:
    """The policy that moves the robot in a mode with inference."""

    dispatch: DispatchStats
    engine: EngineStats
    described: Callable[[], Mapping[str, str]]
    """Which policy it is, and with which weights."""


@attrs.define
class SensorFigures:
    """What is measured of a sensor."""

    received: int
    """Messages so far."""
    rate_hz: float
    age_s: float | None
    """Age of the newest message when it was published, by its stamp; None for messages without one."""


class CommandSource:
    """What gives the active executors something to do in a mode, from `begin` to `end`. This one gives nothing.

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
            IbrobotError: when it cannot; the fault stays.
        """

    def take_goal(self, event: Mapping[str, Any]) -> None:
        """Handle a change of state of an executor's goal."""

    def help(self) -> str:
        """Instructions for the operator in this mode."""
        return ""

    def summary_rows(self) -> list[tuple[str, str]]:
        """What it reports in the summary of the run: heading and text of each row."""
        return []

    def facts(self) -> dict[str, Any]:
        """What it adds to the summary as JSON."""
        return {}


class Session:
    """What the components of a run share. Everything here is safe to read from any thread.

    Attributes:
        config: the robot YAML.
        registry: the plugins.
        request: what the user asks of the run.
        clock: the run's time: real, or stepped in lockstep.
        bus: topics and services within the host process.
        state: the newest state of the joints and of control; None before the first.
        mode: name of the control mode that is active.
        generation: counts mode switches and resets; a plan of an earlier generation moves nothing.
        acting: the policy that acts; None in a mode without one.
        sensors: sensor -> what is measured of it, of those that have given messages.
        outcome: what came of the run so far.
        failure: the component that died and why; None while all is well.
        finished: set when the run should stop.
        operator_events: what the operator asked for by buttons of a teleoperation device, for what records episodes.
        log: where the run writes its log.
        command_source: what gives the active executors something to do.
        held: whether the robot holds after the reset of a fault, until the operator enters the mode again.
        start_failed: whether the run ended before all of it had started: nothing has moved the robot.
    """

    def __init__(self, config: RobotConfig, registry: Registry, request: LaunchRequest) -> None:
        self.config = config
        self.registry = registry
        self.request = request
        # Lockstep begins at a fixed time, so that equal seeds give equal stamps.
        self.clock: Clock = SteppedClock(0) if request.lockstep else RealClock()
        self.bus = Bus(self.clock)
        self.outcome = Outcome()
        self.mode = config.default_control_mode
        self.generation = 0
        self.command_source = CommandSource()
        self.held = False
        self.start_failed = False
        self.state: ControlState | None = None
        self.acting: ActingPolicy | None = None
        self.sensors: dict[str, SensorFigures] = {}
        self.failure: tuple[str, Exception] | None = None
        self.finished = threading.Event()
        self.operator_events: queue.SimpleQueue[OperatorEvent] = queue.SimpleQueue()
        self.log = logging.getLogger("ibrobot")
        self._faults: list[tuple[int, str]] = []
        self._control: ControlHost | None = None
        self._commanding = threading.Lock()

    @cached_property
    def absent(self) -> tuple[AbsentSensor, ...]:
        """The sensors that this machine cannot run, looked for once.

        Raises:
            MissingDependency: as `absent_sensors`.
        """
        return absent_sensors(self.config, self.registry)

    def refuse_absent(self, user: str, needs: Callable[[str], bool]) -> None:
        """Refuse a part of the run that needs the messages of a sensor that cannot run here.

        Args:
            user: what it is, for the error.
            needs: whether it needs the messages on a topic.

        Raises:
            MissingDependency: with the remedy.
        """
        refuse(self.absent, user, needs)

    @property
    def control(self) -> ControlHost:
        """The host's side of control.

        Raises:
            ComponentFailed: before it was made.
        """
        if self._control is None:
            raise ComponentFailed("control is not there yet")
        return self._control

    @control.setter
    def control(self, control: ControlHost) -> None:
        self._control = control

    @property
    def has_control(self) -> bool:
        """Whether control was made."""
        return self._control is not None

    def context(self, name: str, **more: Any) -> Context:
        """The context for a plugin's `make` in the host; `more` are further fields of it."""
        request = self.request
        return self.config.context(name, self.clock, request.seed, bus=self.bus, keys=request.keys, **more)

    def make(self, kind: str, component: ComponentConfig, name: str, **more: Any) -> Any:
        """What the plugin of a component of the YAML makes; `name` and `more` are those of its context."""
        return self.registry.find(kind, component.type).make(component.options, self.context(name, **more))

    def measured(self) -> JointReading:
        """The newest state.

        Raises:
            ComponentFailed: before the first.
        """
        state = self.state
        if state is None:
            raise ComponentFailed("no joint state has come yet")
        return JointReading(state.stamp_ns, state.position, state.velocity, state.effort, state.stale)

    def send_plan(self, start_ns: int, step_ns: int, joints: tuple[str, ...], positions: Vector) -> None:
        """Give control a plan: positions [rad], shape (N, len(joints)), the first at `start_ns` [ns]."""
        robot = self.config.robot
        columns = robot.indices(joints)
        mask = np.zeros(len(robot.joints), dtype=bool)
        mask[columns] = True
        full = np.zeros((len(positions), len(robot.joints)))
        full[:, columns] = positions
        self.control.write_plan(PlanRecord(self.generation, start_ns, step_ns, mask, full))

    def command(self, do: str, **arguments: Any) -> Mapping[str, Any]:
        """Have control carry out a command that begins a new generation: a mode switch, a reset. Returns its answer."""
        with self._commanding:  # the generation of the last command must be the one that stays
            answer = self.control.call(do, **arguments)
            self.generation = int(answer["generation"])
            return answer

    def begin_source(self) -> None:
        """Begin the command source of the mode, unless the robot is `held`."""
        if not self.held:
            self.command_source.begin(self.request.seed)

    def end_source(self) -> None:
        """End the command source of the mode, until `begin_source`."""
        self.command_source.end()

    @property
    def mode_keys(self) -> dict[str, str]:
        """Key -> the mode that it enters: `F1` to `F9`, in the order of the file."""
        return {f"F{i}": name for i, name in enumerate(tuple(self.config.control_modes)[:9], 1)}

    def to_go_on(self) -> str:
        """What the operator does to enter the present mode again."""
        keys = [key for key, mode in self.mode_keys.items() if mode == self.mode]
        return f"{f'press {keys[0]}' if keys else 'call /set_mode'} to go on with {self.mode}"

    def add_fault(self, fault: str, generation: int | None = None) -> None:
        """Note a fault that was raised in `generation`, the present one when None."""
        self.outcome.faults.append(fault)
        self._faults.append((self.generation if generation is None else generation, fault))

    @property
    def failure_text(self) -> str:
        """The component that died and why, on one line; empty while all is well."""
        return f"{self.failure[0]}: {error_line(self.failure[1])}" if self.failure is not None else ""

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults that no reset has cleared yet; `outcome.faults` has all of the run."""
        return tuple(fault for generation, fault in self._faults if generation >= self.generation)

    def counts(self) -> dict[str, Mapping[str, Any]]:
        """All that is counted and measured in a run, in groups such as `loop` and `executor NAME`."""
        report = self.control.report
        counters: Mapping[str, Any] = report["counters"]
        groups = {"loop": {**report["loop"], **counters.get("loop", {})}, "safety": counters.get("safety", {})}
        groups["interventions"] = counters.get("joints", {})
        groups |= {f"executor {name}": values for name, values in counters.get("executors", {}).items()}
        groups |= {f"hardware {name}": values for name, values in counters.get("hardware", {}).items()}
        if self.acting is not None:
            groups |= {"dispatch": attrs.asdict(self.acting.dispatch), "inference": attrs.asdict(self.acting.engine)}
        for name, sensor in self.sensors.items():
            age = {"age_ms": round(sensor.age_s * 1e3, 1)} if sensor.age_s is not None else {}
            groups[f"sensor {name}"] = {"rate_hz": round(sensor.rate_hz, 2), **age}
        groups |= {f"sensor {each.name}": {"missing": str(each.missing)} for each in self.absent}
        groups["bus drops"] = self.bus.dropped()
        return groups

    def emit(self, event: str, **facts: Any) -> None:
        """Tell plugins of an event: this robot, at this time where `facts` has no other `stamp_ns`."""
        self.registry.emit(event, **{"robot": self.config.robot.name, "stamp_ns": self.clock.now_ns(), **facts})

    def finish(self) -> None:
        """End the run in good order."""
        self.finished.set()

    def fail(self, component: str, error: Exception) -> None:
        """End the run because `component` died; only the first cause is reported."""
        if self.failure is None and not self.finished.is_set():
            self.failure = (component, error)
        self.finished.set()


class SessionWorker(Worker):
    """A worker of a run, whose failure ends it.

    Args:
        session: the run; an attribute, too.
        name: unique within the run.
        summary: one line for `--dry-run`.
        needs: names of the components that must be ready before this one starts, e.g. `CONTROL`.
        ready_timeout_s: how long `start` waits to be ready [s].
    """

    def __init__(
        self, session: Session, name: str, summary: str, needs: tuple[str, ...] = (), *, ready_timeout_s: float = 60.0
    ) -> None:
        super().__init__(
            name, summary, needs,
            on_failure=session.fail, lockstep=session.request.lockstep, ready_timeout_s=ready_timeout_s,
        )  # fmt: skip
        self.session = session
