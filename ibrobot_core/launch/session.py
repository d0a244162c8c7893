"""The shared state of a run: config, clock, bus, control, faults, and the active mode."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from typing import Any

import attrs
import numpy as np

from ibrobot_core.bug_reports import as_failure, error_text
from ibrobot_core.bus import Bus
from ibrobot_core.clock import Clock, RealClock, SteppedClock
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.config import RobotConfig
from ibrobot_core.control import commands
from ibrobot_core.control.host import ControlHost
from ibrobot_core.errors import ComponentFailed, HardwareError, IbrobotError, MissingDependency
from ibrobot_core.interfaces import Context, JointReading, OperatorEvent, run_state
from ibrobot_core.interfaces.executor import ExecutorGoal, MoveJoint
from ibrobot_core.interfaces.run import CommandSource, LaunchRequest, MotionScope
from ibrobot_core.launch.absence import by_cause
from ibrobot_core.launch.episodes import Episodes
from ibrobot_core.plugins import Registry
from ibrobot_core.pulses import Pulse
from ibrobot_core.robot import Vector


class Session:
    """The state shared by the components of a run. All attributes may be read from any thread.

    Attributes:
        config: the robot YAML.
        registry: the plugins.
        request: the user's request.
        clock: the clock of the run; real, or stepped in lockstep.
        bus: topics and services within the host process.
        state: the newest state of the joints and of control; None before the first. Set by `take_state`.
        on_state: called with each state before its messages are published, in the thread that receives states.
        on_goal: called with each change of an executor's goal, of any client, in the same thread.
        goal_door: completes and checks the goals of all clients: called with the executor's name, the goal's name, the
            goal, and what sends it to control, once it is checked; None without a plugin that checks goals.
        mode: name of the active control mode.
        generation: counts mode switches and resets; plans of an earlier generation are ignored.
        factors: what the present episode of a simulation has drawn; see `Scene.factors`.
        plan: the newest plan that control was sent; None before the first.
        acting: the policy that moves the robot; None in a mode without inference.
        sensors: sensor -> its measurements, for sensors that have published messages.
        outcome: the outcome of the run so far.
        failure: the component that died and why; None without a failure.
        finished: set when the run should stop.
        stopping: set once the main thread stops the components.
        pulses: signs of life of the threads between a STOP and control. Add one, beat it at least every
            `Pulse.period_s`, and remove it when the thread ends in an orderly way; a thread that stays silent for too
            long ends the run.
        operator_events: the operator's button presses on a teleoperation device, e.g. to begin and end episodes.
        log: the log of the run.
        command_source: the source that commands the active executors.
        episodes: begins, ends and counts the episodes; that of the recorder in a run that records them.
        devices: the open teleoperation devices, which modes share.
        changing: held while the state of the run changes: by a mode switch, a reset, and the beginning or end of a
            simulated episode. An emergency stop never waits for it.
        commander: who commands the robot in a mode in which an operator may take it from the policy: `policy`,
            `operator`, or `handover` while neither does; empty in other modes.
        followed_ns: when the robot last followed the devices of the present mode [ns]: they command it, and it has
            reached their pose; 0 if it has not.
        held: whether the robot holds after the reset of a fault, or after an agent's authority, until the operator
            enters the mode again.
        authority: what agents may do; without them, everything.
        start_failed: whether the run ended before all components had started, so that nothing has moved the robot.
    """

    def __init__(self, config: RobotConfig, registry: Registry, request: LaunchRequest) -> None:
        self.config = config
        self.registry = registry
        self.request = request
        # Lockstep starts at a fixed time, so that equal seeds give equal stamps.
        self.clock: Clock = SteppedClock(0) if request.lockstep else RealClock()
        self.bus = Bus(self.clock)
        self.outcome = run_state.Outcome()
        self.mode = config.default_control_mode
        self.generation = 0
        self.factors: Mapping[str, float] = {}
        self.command_source = CommandSource()
        self.episodes = Episodes(self)
        self.devices = run_state.SharedDevices()
        self.changing = threading.RLock()
        self.commander = ""
        self.followed_ns = 0
        self.held = False
        self.start_failed = False
        self.state: run_state.ControlState | None = None
        self.on_state: list[Callable[[run_state.ControlState], None]] = []
        self.on_goal: list[Callable[[Mapping[str, Any]], None]] = []
        self.goal_door: Callable[[str, str, ExecutorGoal, Callable[[ExecutorGoal], None]], None] | None = None
        self.plan: run_state.PlanRecord | None = None
        self.acting: run_state.ActingPolicy | None = None
        self.sensors: dict[str, run_state.SensorFigures] = {}
        self.failure: tuple[str, Exception] | None = None
        self.finished = threading.Event()
        self.stopping = threading.Event()
        self.pulses: set[Pulse] = set()
        self.operator_events: queue.SimpleQueue[OperatorEvent] = queue.SimpleQueue()
        self.log = logging.getLogger("ibrobot")
        self._faults: list[tuple[int, str]] = []
        self._stopped_by = -1, ""
        """Generation and text of control's last fault."""
        self._control: ControlHost | None = None
        self._commanding = threading.Lock()
        self._new_state = threading.Condition()
        self.authority = MotionScope(self)

    @cached_property
    def absent(self) -> tuple[run_state.AbsentSensor, ...]:
        """The sensors that this machine cannot run; determined once.

        Raises:
            MissingDependency: as `Registry.absent_sensors`.
        """
        return self.registry.absent_sensors(self.config)

    def refuse_absent(self, user: str, needs: Callable[[str], bool]) -> None:
        """Refuse a part of the run that needs the messages of a sensor that cannot run here.

        Args:
            user: name of the part, for the error.
            needs: returns whether the part needs the messages on a topic.

        Raises:
            MissingDependency: with the remedy.
        """
        for missing, labels in by_cause(sensor for sensor in self.absent if needs(sensor.topic)):
            raise MissingDependency(f"{user} needs {labels}: {missing.missing}", apt=missing.apt, remedy=missing.remedy)

    @property
    def simulates_episodes(self) -> bool:
        """Whether the mode begins and ends episodes itself: that of a policy in a simulation."""
        by_policy = self.config.control_modes[self.mode].inference is not None and self.request.source is None
        return self.config.simulated and by_policy

    @property
    def control(self) -> ControlHost:
        """The host's side of control.

        Raises:
            ComponentFailed: before control was created.
        """
        if self._control is None:
            raise ComponentFailed("control has not started yet")
        return self._control

    @control.setter
    def control(self, control: ControlHost) -> None:
        self._control = control

    @property
    def has_control(self) -> bool:
        """Whether control was created."""
        return self._control is not None

    @property
    def signals(self) -> Sequence[tuple[str, int]]:
        """Topic and size of each signal of the hardware, in the order of `ControlState.signals`."""
        return self.control.signals

    @property
    def conditions(self) -> Sequence[Mapping[str, Any]]:
        """The conditions of joints in control's last report."""
        return list(self.control.report["counters"].get("conditions", ()))

    def make(self, kind: str, component: ComponentConfig, name: str, **more: Any) -> Any:
        """Make a component of the YAML by its plugin; `name` and `more` go into the context."""
        given = {"bus": self.bus, "keys": self.request.keys, "session": self, **more}
        context = Context.of(self.config, name, self.clock, self.request.seed, **given)
        return self.registry.create(kind, component.type, component.options, context)

    def take_state(self, state: run_state.ControlState) -> None:
        """Set the newest state, and wake those who wait for it."""
        with self._new_state:
            self.state = state
            self._new_state.notify_all()
        for call in tuple(self.on_state):
            call(state)

    def watch_states(self) -> run_state.StateWatch:
        """Wait for the states from now on: one at each tick of control, even while the joints do not answer.

        `/joint_states`, in contrast, has a message only for each state that was measured.
        """
        return run_state.StateWatch(lambda: self.state, self._new_state)

    def measured(self) -> JointReading:
        """The newest joint state.

        Raises:
            ComponentFailed: before the first state.
        """
        state = self.state
        if state is None:
            raise ComponentFailed("no joint state has been received yet")
        return JointReading(state.stamp_ns, state.position, state.velocity, state.effort, state.stale)

    def send_plan(self, start_ns: int, step_ns: int, joints: tuple[str, ...], positions: Vector) -> None:
        """Send control a plan: positions [rad], shape (N, len(joints)), the first at `start_ns` [ns]."""
        robot = self.config.robot
        columns = robot.indices(joints)
        mask = np.zeros(len(robot.joints), dtype=bool)
        mask[columns] = True
        full = np.zeros((len(positions), len(robot.joints)))
        full[:, columns] = positions
        with self.authority.lock:  # no plan overtakes the end of an agent's authority
            if self.authority.admits_plan(joints, positions):
                self.plan = run_state.PlanRecord(self.generation, start_ns, step_ns, mask, full)
                self.control.write_plan(self.plan)

    def send_goal(self, executor: str, goal_id: str, goal: ExecutorGoal, stops: int | None = None) -> None:
        """Send a goal to an executor of the present mode: the one door for the goals of every client.

        Args:
            executor: its name.
            goal_id: names the goal in events.
            goal: as for `Executor.set_goal`.
            stops: number of emergency stops when it was requested; control refuses it after a newer one.

        Raises:
            PlanningError: if it fails a check of limits or of the world.
            IbrobotError: if the robot is stopped or holds, or the executor refuses it.
        """
        if self.faults or self.held:
            raise HardwareError(f"refused before a reset: {(*self.faults, f'holding: {self.to_go_on()}')[0]}")

        generation = self.generation

        def send(checked: ExecutorGoal) -> None:
            with self.authority.lock:  # no goal overtakes the end of an agent's authority
                if self.held:
                    raise HardwareError(f"refused: holding: {self.to_go_on()}")
                if isinstance(checked, MoveJoint):  # its setpoint must not run ahead of the commands
                    checked = attrs.evolve(checked, speed=min(checked.speed, self.authority.speed))
                self.control.call(commands.SendGoal(executor, goal_id, checked, stops, generation))

        send(goal) if self.goal_door is None else self.goal_door(executor, goal_id, goal, send)

    def change_world(self, change: Mapping[str, Any]) -> None:
        """Tell the guard of the control process of a change of the world, in the words of its plugin.

        Raises:
            IbrobotError: if the guard refuses it, or control has died.
        """
        self.control.call(commands.ChangeWorld(change))

    def limit_speed(self, fraction: float) -> None:
        """Limit all joints to a fraction of their velocity limits."""
        self.control.call(commands.LimitSpeed(fraction))

    def cancel_goals(self, executor: str = "") -> None:
        """Cancel the goal of an executor, or all goals if it is empty; the executors then hold.

        Raises:
            ComponentFailed: if control has died.
        """
        self.control.call(commands.CancelGoals(executor))

    def hold(self) -> None:
        """Brake, and hold until a person enters the mode again; a source that moves by itself ends.

        Raises:
            ComponentFailed: if control has died.
        """
        self._brake()
        with self.changing:  # another mode may have been entered meanwhile
            self.held = True
            if self.command_source.autonomous:
                self.end_source()
            self._brake()

    def _brake(self) -> None:
        """Cancel all goals, and replace the plan by one without joints; what a gripper holds stays held."""
        self.cancel_goals()
        none = np.zeros((1, len(self.config.robot.joints)))
        self.control.write_plan(run_state.PlanRecord(self.generation, self.clock.now_ns(), 1, none[0] > 0, none))

    def raise_fault(self, fault: str) -> None:
        """Have control brake all joints and hold until a reset.

        Raises:
            ComponentFailed: if control has died.
        """
        self.control.call(commands.RaiseFault(fault))

    def reset_episode(self, seed: int) -> bool:
        """Set up the simulated scene again; False if an emergency stop is latched, so that nothing has changed."""
        return bool(self.command(commands.ResetEpisode(seed))["begun"])

    def end_episode(self, outcome: str) -> None:
        """End the present episode, if any, as `Episodes.end`; a source that knows how it went calls it."""
        self.episodes.end(outcome)

    @property
    def stops(self) -> int:
        """Number of emergency stops in this run, as far as known here; see `ControlState.stops`."""
        return self._control.stops if self._control is not None else 0

    def emergency_stop(self) -> None:
        """Brake all joints and hold, from any thread and at any time. Before control runs, the run ends.

        Raises:
            IbrobotError: if control does not confirm it.
        """
        if self._control is None or not self._control.running:
            self.finish()
            self.log.error("emergency stop while nothing commands the robot: the run ends")
            return
        try:
            self._control.call(commands.EmergencyStop())
        except IbrobotError:
            raise
        except BaseException as error:  # e.g. no memory: it may not have been sent, and the next one would not be
            self.fail("emergency stop", error)
            with suppress(Exception):
                self._control.call(commands.RaiseFault("an emergency stop could not be sent"))
            raise

    def check_stop(self) -> None:
        """Go the way of `emergency_stop` to control and back, and stop nothing.

        Raises:
            IbrobotError: if control does not answer.
        """
        if self._control is not None and self._control.running:
            self._control.call(commands.GetCounters())

    def command(self, command: commands.SwitchMode | commands.ClearFaults | commands.ResetEpisode) -> Mapping[str, Any]:
        """Execute a command that begins a new generation, e.g. a mode switch, and return control's answer."""
        with self._commanding:  # keep the generation of the last command
            answer = self.control.call(command)
            self.generation = int(answer["generation"])
            self.factors = answer.get("factors", self.factors)
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
        """Key -> the mode it enters: `F1` to `F9`, in file order."""
        return {f"F{i}": name for i, name in enumerate(tuple(self.config.control_modes)[:9], 1)}

    def pass_on(self, event: OperatorEvent) -> None:
        """Pass a button press that concerns episodes to the command that records them."""
        if self.request.by_operator:
            self.operator_events.put(event)
        else:
            self.log.warning("%s: this run records no episodes by hand", event)

    def to_go_on(self) -> str:
        """Instruction for entering the present mode again."""
        keys = [key for key, mode in self.mode_keys.items() if mode == self.mode]
        return f"{f'press {keys[0]}' if keys else 'call /set_mode'} to go on with {self.mode}"

    def add_fault(self, fault: str, generation: int | None = None) -> None:
        """Add a fault that control raised in `generation`; None stands for one that does not stop the robot."""
        self.outcome.faults.append(fault)
        self._faults.append((self.generation if generation is None else generation, fault))
        if generation is not None:
            self._stopped_by = generation, fault
            self.episodes.faults += (fault,)

    @property
    def stopped_by(self) -> str:
        """The last fault or emergency stop for which control holds the robot until a reset; empty if it does not."""
        generation, fault = self._stopped_by
        return fault if generation >= self.generation else ""

    @property
    def failure_text(self) -> str:
        """The component that died and why, on one line; empty without a failure."""
        return f"{self.failure[0]}: {error_text(self.failure[1], '; ')}" if self.failure is not None else ""

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults not cleared by a reset yet; `outcome.faults` has all faults of the run."""
        return tuple(fault for generation, fault in self._faults if generation >= self.generation)

    def counts(self) -> dict[str, Mapping[str, Any]]:
        """All counters and measurements of the run, in groups such as `loop` and `executor NAME`."""
        report = self.control.report
        counters: Mapping[str, Any] = report["counters"]
        groups = {"loop": {**report["loop"], **counters.get("loop", {})}, "safety": counters.get("safety", {})}
        groups["interventions"] = counters.get("joints", {})
        groups |= {"guard": counters["guard"]} if counters.get("guard") else {}
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
        """Call the plugins' hooks for an event, with the robot's name and, unless given, the present `stamp_ns`."""
        self.registry.emit(event, **{"robot": self.config.robot.name, "stamp_ns": self.clock.now_ns(), **facts})

    def finish(self) -> None:
        """End the run in an orderly way."""
        self.finished.set()

    def fail(self, component: str, error: BaseException) -> None:
        """End the run because `component` died; only the first cause is reported."""
        if self.failure is None and not self.finished.is_set():
            self.failure = (component, as_failure(error))
        self.finished.set()
