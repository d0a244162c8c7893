"""The control core: read, executors, safety and write in each tick; modes, goals, faults and stop behaviours."""

from __future__ import annotations

import json
import logging
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Self

import attrs
import numpy as np

from ibrobot_core.clock import Clock
from ibrobot_core.component_config import ComponentConfig
from ibrobot_core.config import RobotConfig
from ibrobot_core.control import commands
from ibrobot_core.control.active import ActiveExecutors
from ibrobot_core.control.following import FollowingError
from ibrobot_core.control.hardware_group import HardwareGroup
from ibrobot_core.control.health import Health
from ibrobot_core.control.phase import TRANSITIONS, Cause, Phase
from ibrobot_core.control.pose_motion import TIMEOUT_S, PoseMotion
from ibrobot_core.control.readings import Readings
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.control.timing import TOO_BUSY, Pace
from ibrobot_core.errors import ConfigError, HardwareError, IbrobotError, NotSupported, Problem
from ibrobot_core.interfaces import Context, EpisodeSetup, Executor, Guard, JointReading, Signal, Torque
from ibrobot_core.interfaces.executor import ExecutorGoal
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.plugins import Registry
from ibrobot_core.robot import Vector
from ibrobot_core.units import NS_PER_S, ns

EMERGENCY_STOP = "emergency stop"
"""The fault raised by `/estop`."""
_FIRST_READING_S = 2.0
"""How long a start tries: the computer may be busy with starting the rest."""
_RECENT_NS = NS_PER_S
"""Time after its last command for which a robot at rest counts as commanded [ns]."""
_POSE_TOLERANCE = 0.2
"""Largest distance of a joint from the commanded startup pose, e.g. due to its weight [rad]."""
_SUSPENDED_NS = ns(0.1)
"""Shortest suspend that is a fault [ns]."""


class ControlCore:
    """The control loop without its timing: `tick` once per period, `handle` for commands, `events` for the host.

    Args:
        config: the robot YAML.
        hardware: all hardware of the robot; connected by `start`.
        executors: name -> executor.
        clock: the source of stamps.
        guard: what keeps commands from leading to a collision.

    Attributes:
        phase: what the loop does; `TRANSITIONS` has what leads to another one.
        take_stops: executes emergency stops that have arrived; called during commands that may take long.
        stops: number of emergency stops so far, also of those pressed while one was latched.
    """

    def __init__(
        self, config: RobotConfig, hardware: HardwareGroup, executors: Mapping[str, Executor], clock: Clock,
        guard: Guard | None = None,
    ) -> None:  # fmt: skip
        self._log = logging.getLogger("ibrobot.control")
        self._config = config
        self._robot = config.robot
        self._hardware = hardware
        self._clock = clock
        self.period_ns = ns(1.0 / config.control.rate_hz)
        self._guard = guard
        self._safety = SafetyLayer(config.robot, self.period_ns, guard)
        self._overruled = ""
        self._pose = PoseMotion(self._safety, clock)
        self._readings = Readings(hardware, config.robot, clock, self.period_ns, ns(config.control.state_timeout))
        self._counts = {"write_errors": 0, "signal_errors": 0, "old_plans": 0, "following_errors": 0}
        self._relaxed = False
        self._following = FollowingError(config.control.following_error, config.robot, self.period_ns)
        self._yielded: Vector | None = None
        """Held positions of joints that did not follow, until a reset [rad]; NaN for the others, shape (J,)."""
        # A value is too low if the process is interrupted between its two clocks, never too high.
        self._asleep_ns = max(clock.asleep_ns() for _ in range(3))
        self._health = Health(config.control.load_shedding, self._log)
        self._pace = Pace(self.period_ns)
        self._commanded_ns: int | None = None
        """Time of the last plan or goal of this generation [ns]; None before the first."""
        self._unwell = ""
        """The fault, if a joint's condition caused it; otherwise empty."""
        self._tick = 0
        self._due_ns = clock.now_ns()
        self._acts: Mapping[type[commands.Command], Callable[..., Mapping[str, Any] | None]] = {
            commands.SwitchMode: self._switch_mode,
            commands.ResetEpisode: self._reset_episode,
            commands.EmergencyStop: self.emergency_stop,
            commands.RaiseFault: self._raise_fault,
            commands.ClearFaults: self._reset,
            commands.SendGoal: self._goal,
            commands.CancelGoals: lambda executor: self._executors.cancel(self._at_tick, executor),
            commands.GetCounters: self.counters,
            commands.Halt: self._halt,
            commands.BeginStartup: self.begin_startup,
            commands.LimitSpeed: self._safety.limit_speed,
            commands.ChangeWorld: lambda change: None if guard is None else guard.world(change),
        }
        """What executes a command, with its fields as arguments."""
        self.take_stops: Callable[[], None] = lambda: None
        self.stops = 0
        self.phase = Phase.RUNNING
        self.mode = ""
        self.generation = 0
        self.fault = ""
        self.events: deque[Mapping[str, Any]] = deque()
        """Events for the host, of kinds `goal`, `fault` and `guard`."""
        self._executors = ActiveExecutors(config.robot, executors, self.events.append, self._rest)
        self.state: ControlState | None = None
        """Readings and commands of the last tick; None before the first."""

    @classmethod
    def of(cls, config: RobotConfig, registry: Registry, clock: Clock, seed: int) -> Self:
        """Build the control core of `config` without connecting any hardware.

        Raises:
            ConfigError: if the robot has neither hardware nor a simulation.
            PluginError: if a plugin is missing.
        """
        simulation = config.simulation if config.simulated else None

        def make(kind: str, component: ComponentConfig, name: str, joints: tuple[str, ...]) -> Any:
            options = simulation.options if simulation is not None else None
            context = Context.of(config, name, clock, seed, joints=joints, simulation=options)
            return registry.create(kind, component.type, component.options, context)

        executors = {name: make("executor", each, name, each.joints) for name, each in config.executors.items()}
        if simulation is not None:
            hardware = {"simulation": make("hardware", simulation, "simulation", config.robot.joint_names)}
        elif config.hardware:
            hardware = {name: make("hardware", each, name, each.joints) for name, each in config.hardware.items()}
        else:
            problem = "neither hardware nor simulation is there: nothing to control"
            raise ConfigError([Problem(str(config.source), 0, "hardware", problem)])
        named = config.control.guard
        guard = None if named is None else make("guard", named, "guard", config.robot.joint_names)
        group = HardwareGroup(config.robot, hardware, config.control.state_timeout)
        return cls(config, group, executors, clock, guard)

    def start(self, mode: str) -> None:
        """Connect, hold the joints at their measured positions, and enter `mode` once `arrived`.

        On failure, torque switched on here is switched off again.

        Raises:
            HardwareError: if the hardware does not connect or its first reading is not a valid position.
            NotSupported: if the stop behaviour is `relax` and a part cannot relax.
        """
        if self._config.control.stop == "relax":
            self._hardware.require_relax()
        self._hardware.connect()
        try:
            self._readings.newest = self._readings.first(_FIRST_READING_S)
            self._safety.activate(self._readings.newest.position)
        except HardwareError:
            self._hardware.undo_connect()
            raise
        self.mode = mode
        if self._config.control.startup.startswith("pose"):
            self.phase = Phase.ARRIVING
        else:
            self._switch_mode(mode)

    def begin_startup(self) -> None:
        """Begin the motion to the startup pose, if there is one, now that everything is there that may stop it."""
        if self.phase is Phase.ARRIVING:
            self._move_to(self._config.control.startup.partition(" ")[2])

    def arrived(self) -> bool:
        """Whether the robot has entered its mode; keep calling `tick`.

        From `begin_startup` on, it moves to its startup pose.

        Raises:
            HardwareError: after a fault or an emergency stop during the motion, or if it takes too long; the robot is
                at rest then.
        """
        if self.phase is Phase.FAILED:
            if not (self._safety.at_rest or self._relaxed):
                return False  # still braking
            raise HardwareError(f"control.startup: {self._config.control.startup}: {self.fault}")
        if self.phase is not Phase.ARRIVING or self._pose.target is None:  # it waits for `begin_startup`
            return self.phase is not Phase.ARRIVING
        measured = self._readings.newest
        away = np.abs(measured.position - self._pose.target)
        # The mode starts at the pose; the joints must be there, by a reading that is not old.
        if self._pose.reached and not measured.stale and away.max() <= _POSE_TOLERANCE:
            self._pose.end()
            self._advance(Cause.ARRIVED)
            self._switch_mode(self.mode)
            return True
        if self._pose.late and self._safety.at_rest:
            joint, held = self._robot.joint_names[int(away.argmax())], self._pose.held
            why = f"the guard held it: {json.loads(held)['text']}" if held else "check that nothing is in its way"
            raise HardwareError(
                f"control.startup: {self._config.control.startup}: not reached within {TIMEOUT_S:g} s: "
                f"{joint} is {away.max():.2f} rad away; {why}"
            )
        return False

    def tick(self, due_ns: int | None = None, late_ns: int = 0, periods: int = 1) -> ControlState:
        """Run one cycle.

        Args:
            due_ns: the time of the cycle, by which executors compute their setpoints; None for the present time.
            late_ns: delay of the cycle's start [ns], stored in the state.
            periods: periods since the last tick; more than one after missed ticks, to keep simulated time in step.
        """
        self._due_ns = self._clock.now_ns() if due_ns is None else due_ns
        self._check_suspend()
        begun_ns = self._clock.now_ns()
        if (fault := self._readings.read()) is not None:
            self._raise_fault(fault)
        if slow := self._pace.tick(periods, self._clock.now_ns() - begun_ns):
            self._log.warning("%s", slow)
        signals = self._read_signals()
        success = self._hardware.success()
        self._check_following()
        self._check_health()
        measured = self._readings.newest
        desired = self._desired()
        command = self._safety.apply(desired, measured.position)
        if self._safety.overruled and desired is not None:
            self._executors.note_guard(self._safety.overruled, command != desired)
            self._pose.held = self._safety.overruled
        if (overruled := self._safety.overruled) != self._overruled:
            self._overruled = overruled
            self.events.append({"event": "guard", "overruled": overruled})
        if self._safety.guard_fault:
            self._raise_fault(self._safety.guard_fault)
        self._write(command)
        self._hardware.advance(periods * self.period_ns)
        self._tick += 1
        self.state = ControlState(
            tick=self._tick, stamp_ns=measured.stamp_ns, late_ns=late_ns, generation=self.generation,
            estop=self._safety.estopped, stale=measured.stale, success=success, position=measured.position,
            velocity=measured.velocity, effort=measured.effort, command=command, signals=signals, stops=self.stops,
        )  # fmt: skip
        return self.state

    def set_plan(self, plan: PlanRecord) -> None:
        """Pass a plan to the active executors of its joints; plans of an earlier generation are only counted.

        It replaces the plan before: executors that followed that one and have no joints in this one brake.
        """
        if plan.generation != self.generation or self.fault:
            self._counts["old_plans"] += 1
            return
        self._commanded_ns = self._clock.now_ns()
        self._executors.set_plan(plan, self._at_tick)

    def note_silence(self, silent_s: float, fault: str, *, stopped: bool = False) -> None:
        """Raise a fault if braking must begin for motion to end within `control.peer_timeout` of a silence.

        A robot that nobody commands needs none: at rest, without a policy, and without a plan for a second.

        Args:
            silent_s: how long the host, or this loop, has not run [s].
            fault: what happened.
            stopped: whether a signal stopped the process, as Ctrl-Z does.
        """
        longest_s = self._config.control.peer_timeout
        if silent_s <= longest_s / 3 or self.fault or self.phase is Phase.STOPPING or not self._is_commanded:
            return
        braking_s = float(np.max(np.abs(self._safety.velocity) / self._robot.max_acceleration))
        if silent_s + braking_s >= longest_s:
            remedy = f"; {TOO_BUSY}" if self._config.simulated and not stopped else ""
            self._raise_fault(f"{fault} for {silent_s * 1e3:.0f} ms{remedy}")

    def handle(self, command: commands.Command) -> dict[str, Any]:
        """Execute a command of the host and return the answer; that to a refused command has the key `error`."""
        try:
            if self.phase not in commands.PERMITTED.get(type(command), (self.phase,)):
                cause = f": {self.fault}" if self.phase is Phase.FAULTED else ""
                raise HardwareError(f"refused {self.phase.value}{cause}")
            result = self._acts[type(command)](**attrs.asdict(command, recurse=False)) or {}
        except IbrobotError as error:
            return {"stops": self.stops, "error": str(error)}
        return {"stops": self.stops, "generation": self.generation, **result}

    def counters(self) -> dict[str, Any]:
        """Counts of all interventions and refusals by the safety layer, the executors, the hardware and the loop."""
        return {
            "safety": dict(self._safety.counters()),
            "guard": {} if self._guard is None else dict(self._guard.counts),
            "joints": dict(self._safety.interventions),
            "executors": self._executors.counters(),
            "hardware": self._hardware.counters(),
            "loop": {**self._readings.counts, **self._counts, "slow_seconds": self._pace.slow_seconds},
            "conditions": [attrs.asdict(each) for each in self._health.conditions],
        }

    def begin_stop(self, *, unmoved: bool = False) -> None:
        """Start the configured stop behaviour, unless it has begun; keep calling `tick` until `stopped`.

        Args:
            unmoved: whether nothing has moved the robot, since the start failed elsewhere; torque that the start
                switched on is then switched off again.
        """
        if self.phase is Phase.STOPPING:
            return
        self._advance(Cause.STOP)
        self._leave()
        self._pose.end()
        if unmoved and self._config.control.startup == "hold":
            self._hardware.undo_connect()
            self._relaxed = True
            return
        behaviour, _, pose = self._config.control.stop.partition(" ")
        if behaviour == "relax":
            self._relax("stop")
        elif behaviour == "pose" and not self.fault and not self._safety.estopped:
            self._move_to(pose)

    def holding(self) -> list[str]:
        """One line for each part that holds torque, with the command that switches it off. Also valid after `close`."""
        return [f"{each.where} holds torque; to take it off: `{each.command}`" for each in self._hardware.holding()]

    @property
    def signals(self) -> tuple[Signal, ...]:
        """The hardware's signals, in the order of `ControlState.signals`."""
        return self._hardware.signals

    @property
    def signal_size(self) -> int:
        """Total size of all signals."""
        return sum(signal.size for signal in self.signals)

    @property
    def stopped(self) -> bool:
        """Whether the stop behaviour has finished."""
        moves = self._pose.target is not None and not self._pose.late
        return self._relaxed or (self._pose.reached if moves else self._safety.at_rest)

    def abandon(self) -> None:
        """Switch torque off if the stop behaviour is `relax`; for a loop that cannot tick because of a bug."""
        if self.state is not None and self._config.control.stop == "relax":
            self._relax("the control loop failed")

    def close(self) -> None:
        """Release the hardware."""
        self._hardware.disconnect()

    def _advance(self, cause: Cause) -> None:
        self.phase = TRANSITIONS[self.phase].get(cause, self.phase)

    @property
    def _is_commanded(self) -> bool:
        """Whether someone has the robot move, or may have it move on without being asked again."""
        if not self._safety.at_rest:
            return True
        if self._commanded_ns is None:
            return False
        by_policy = self._config.control_modes[self.mode].inference is not None
        return by_policy or self._clock.now_ns() - self._commanded_ns < _RECENT_NS

    def _move_to(self, pose: str) -> None:
        self._pose.begin(self._robot.pose(pose.strip()))

    @property
    def _at_tick(self) -> JointReading:
        """The reading at the time of the cycle: executors see equal periods even if cycles are late."""
        return attrs.evolve(self._readings.newest, stamp_ns=self._due_ns)

    def _check_suspend(self) -> None:
        """Raise a fault if the computer was asleep: whatever was planned before belongs to another time."""
        slept_ns = self._clock.asleep_ns() - self._asleep_ns
        self._asleep_ns += max(0, slept_ns)
        if slept_ns >= _SUSPENDED_NS:
            self._raise_fault(f"the computer was suspended for {slept_ns / NS_PER_S:.1f} s")

    def _read_signals(self) -> Vector:
        try:
            return self._hardware.read_signals()
        except HardwareError:
            # Unlike missing joints, missing signals do not stop the robot.
            self._counts["signal_errors"] += 1
            return np.full(self.signal_size, np.nan)

    def _check_following(self) -> None:
        """Raise a fault if a joint does not follow, and stop pressing against the obstacle."""
        reading = self._readings.newest
        if self.fault or self._relaxed or reading.stale:
            return
        commanded, measured = self._safety.current, reading.position
        fault = self._following.check(commanded, self._safety.velocity, measured)
        if fault:
            self._counts["following_errors"] += 1
            self._raise_fault(fault)
            self._yielded = np.where(self._following.lost, measured, np.nan)

    def _check_health(self) -> None:
        """Raise a fault for a severe condition; shed load once it has lasted too long."""
        conditions = self._hardware.health()
        if conditions or self._health.conditions:
            now_ns = self._clock.now_ns()
            self._health.update(conditions, now_ns)
            sheds = Cause.OVERDUE in TRANSITIONS[self.phase] and not self._relaxed
            if sheds and (why := self._health.overdue(now_ns)):
                self._shed(why)
            if (fault := self._health.fault) and not self.fault:
                self._unwell = fault
                self._raise_fault(fault)
        if self.phase is Phase.SHEDDING:
            reached = self._pose.reached
            if reached or self._pose.late or self._readings.silent:
                self._pose.end()
            if reached or (self._pose.target is None and self._safety.at_rest):
                self._advance(Cause.RELAXED)
                self._relax("load shedding")

    def _shed(self, why: str) -> None:
        """Move to the load-shedding pose, unless a fault other than the joints' health prevents motion, then relax."""
        options = self._config.control.load_shedding
        moves = options.pose and self.fault in ("", self._unwell) and not self._safety.estopped
        then = f"goes to pose {options.pose} and relaxes" if moves else "relaxes"
        self._announce(f"{why}; this has lasted for {options.after:g} s", then)
        self._advance(Cause.OVERDUE)
        if moves:
            self._move_to(options.pose)

    def _write(self, command: Vector) -> None:
        if self._relaxed:
            return
        try:
            self._hardware.write(command)
        except HardwareError as error:
            self._counts["write_errors"] += 1
            self._raise_fault(str(error))

    def _desired(self) -> Vector | None:
        """The desired positions of this tick [rad], shape (J,); None to brake and hold."""
        if self._pose.target is not None:
            return self._pose.desired()
        if not self._executors:
            held = self._yielded
            return None if held is None else np.where(np.isnan(held), self._safety.current, held)
        setpoints = self._executors.update(self._at_tick)
        relax = self._executors.want_relax
        if relax and not self._relaxed:
            self._relax("the setpoints are stale")
        elif self._relaxed and not relax and not self._restore_torque():
            return None
        desired = self._safety.current
        for columns, setpoint in setpoints:
            desired[columns] = setpoint
        return desired

    def _relax(self, why: str) -> None:
        """Switch torque off and report the outcome for each part, even if a fault is already set."""
        outcomes = self._hardware.relax()
        self._relaxed = not self._hardware.holds
        off = [name for name, outcome in outcomes.items() if outcome is Torque.OFF]
        if off:
            parts = f" of {', '.join(off)}" if len(off) < len(outcomes) else ""
            self._log.warning("torque%s off (%s): the arm may fall", parts, why)
        for name, outcome in outcomes.items():
            if outcome is Torque.UNKNOWN:
                self._announce(f"torque of {name} may still be on: nothing confirmed that it is off", "may hold")
            elif outcome is not Torque.OFF:
                self._announce(f"torque of {name} cannot be taken off: {outcome}", "holds")

    def _restore_torque(self) -> bool:
        """Switch torque on at the measured positions. Raise a fault and return False if they are unknown."""
        try:
            if self._readings.newest.stale:
                raise HardwareError("the joints do not answer")
            self._safety.activate(self._readings.newest.position)
        except HardwareError as error:
            self._raise_fault(f"torque stays off: {error}")
            return False
        self._after_relax()
        return True

    def _after_relax(self) -> None:
        self._relaxed = False
        self._hardware.resume()
        self._health.restart()

    def _raise_fault(self, fault: str) -> None:
        if self.fault:
            return
        fault = fault.strip() or "a fault without a message"
        relaxes = self._config.control.stop == "relax"
        self._announce(fault, "relaxes" if relaxes else "holds")
        if relaxes and not self._relaxed:
            self._relax("fault")

    def _announce(self, fault: str, then: str) -> None:
        """Report a fault to the host, even if another is set; `then` states what the robot does."""
        # The generation lets the host know which faults a later reset cleared. The first fault begins a new one. Its
        # event comes before those of the goals that it cancels, so that the host knows their cause.
        generation, stamp_ns = self.generation + (not self.fault), self._clock.now_ns()
        self.events.append(
            {"event": "fault", "fault": fault, "then": then, "stamp_ns": stamp_ns, "generation": generation}
        )
        if not self.fault:
            self.fault = fault
            self._advance(Cause.FAULT)
            self._leave()
            self._pose.end()

    def _rest(self) -> Vector:
        """Where the joints come to rest if they brake now [rad], shape (J,); without torque, where they are."""
        return self._readings.newest.position if self._relaxed else self._safety.rest

    def _leave(self) -> None:
        """Deactivate all executors; without one, every joint brakes and holds."""
        self._executors.leave(self._at_tick)
        self._commanded_ns = None
        self.generation += 1

    def _enter(self) -> None:
        self._executors.enter(self._config.control_modes[self.mode].executors, self._at_tick)
        self.generation += 1

    def _switch_mode(self, mode: str) -> None:
        if mode not in self._config.control_modes:
            raise NotSupported(f"no mode {mode!r}; the modes are: {', '.join(self._config.control_modes)}")
        self._leave()
        self.mode = mode
        self._enter()

    def _reset_episode(self, seed: int) -> dict[str, Any]:
        """Set up the scene again, which clears faults; not an emergency stop, since only a person may do so.

        Returns:
            `begun`: whether it was set up; false if an emergency stop is latched. `factors`: what it has drawn.
        """
        self.take_stops()
        if self._safety.estopped:
            return {"begun": False}
        self._leave()
        self._hardware.reset_episode(EpisodeSetup(seed))
        self._hardware.reset_faults()
        self._begin_again(self._readings.first())
        return {"begun": True, "factors": self._hardware.factors}

    def emergency_stop(self) -> None:
        """Brake and hold, whatever the robot does; a load that was to be shed is given its time again."""
        self.stops += 1
        self._safety.estop()
        self._pose.end()
        self._health.restart()
        self._advance(Cause.EMERGENCY_STOP)
        self._raise_fault(EMERGENCY_STOP)

    def _halt(self, *, unmoved: bool, ends: bool) -> dict[str, Any]:
        """Begin the stop behaviour; `halted` says whether it has finished."""
        self.begin_stop(unmoved=unmoved)
        return {"halted": self.stopped}

    def _reset(self, stops: int | None) -> dict[str, Any]:
        """Clear faults and the emergency stop, and enter the mode again at the measured positions.

        Args:
            stops: the number of emergency stops that the sender knew of; None: all so far.

        Returns:
            `cleared`: the cleared fault, or empty if none was set.

        Raises:
            HardwareError: if the robot is still braking, the sender did not know of a stop, one arrives during the
                reset, or the joints have no valid positions. Nothing has changed then.
        """
        stops = self.stops if stops is None else stops
        self._refuse_after(stops)
        cleared = self.fault
        if not self._safety.at_rest and not self._relaxed:
            if cleared:
                raise HardwareError("the robot is still braking: reset it when it has stopped")
            # The robot moves as commanded: restart the executors only, so that commands continue within the limits.
            self._switch_mode(self.mode)
        else:
            self._hardware.reset_faults()
            self.take_stops()
            self._refuse_after(stops)
            self._begin_again(self._readings.first())
        return {"cleared": cleared}

    def _refuse_after(self, stops: int) -> None:
        if self.stops > stops:
            raise HardwareError("reset: refused, an emergency stop came after it was requested")

    def _begin_again(self, measured: JointReading) -> None:
        """Enter the mode at `measured`, without faults.

        Raises:
            HardwareError: if it is not a valid position; nothing has changed then.
        """
        self._safety.reset(measured.position)
        self._readings.newest = measured
        self._leave()
        self._pose.end()
        self._after_relax()
        self._yielded = None
        self.fault = self._unwell = ""
        self._advance(Cause.RESET)
        self._enter()

    def _goal(self, executor: str, goal_id: str, goal: ExecutorGoal, stops: int | None, generation: int | None) -> None:
        """Pass a goal to an executor; one requested before an emergency stop, or in another generation, is refused."""
        if generation not in (None, self.generation) or (stops is not None and self.stops > stops):
            raise HardwareError(f"goal {goal_id}: refused, a stop, a reset or another mode came after it was requested")
        self._executors.set_goal(executor, goal_id, goal, self._at_tick)
        self._commanded_ns = self._clock.now_ns()
