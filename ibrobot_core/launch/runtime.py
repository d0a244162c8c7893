"""The runtime: starts a plan's components in order, runs them until the run ends, and stops them in reverse."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import NoneType
from typing import Any

import attrs

from ibrobot_core.bug_reports import error_text, exit_code
from ibrobot_core.clock import SteppedClock
from ibrobot_core.component import Component
from ibrobot_core.config.missing import absent_models, unavailable_modes
from ibrobot_core.contract.specs import Contract
from ibrobot_core.control.commands import ClearFaults, SwitchMode
from ibrobot_core.errors import ComponentFailed, HardwareError, IbrobotError, NotSupported, PluginError
from ibrobot_core.launch.control import ControlComponent
from ibrobot_core.launch.plan import LaunchPlan, build_plan, mode_components
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import CompressedImage, Image
from ibrobot_core.options import documented, option
from ibrobot_core.services import NoRequest, Service
from ibrobot_core.units import ns


@documented
@attrs.frozen
class SetMode:
    """A request to `/set_mode`."""

    mode: str = option(help="a control mode of the robot YAML")
    prompt: str = option("", help="task of the mode's policy, in place of that of the robot YAML")
    stops: int | None = option(None, ge=0, help="number of emergency stops that the sender knew of; none: all so far")


@documented
@attrs.frozen
class Reset:
    """A request to `/reset`."""

    stops: int | None = option(None, ge=0, help="number of emergency stops that the sender knew of; none: all so far")


SET_MODE = Service("/set_mode", SetMode, NoneType, "Enter another control mode.", alone="mode")
"""The service `/set_mode`."""
RESET = Service("/reset", Reset, str, "Clear faults and stops; answers with what the robot does now.", persons=True)
"""The service `/reset`."""
ESTOP = Service("/estop", NoRequest, NoneType, "Stop the robot at once, and hold until a reset.", urgent=True)
"""The service `/estop`."""
CHECK_ESTOP = Service("/estop/check", NoRequest, NoneType, "Go the way of a stop, and stop nothing.", urgent=True)
"""The service `/estop/check`, by which each way of a stop is tried out when a run starts."""
_CHANGE_S = 2.0
"""How long the end of a run waits for a mode switch or reset under way [s]."""
_PICTURES = (Image.ros_type, CompressedImage.ros_type)
"""The contract reads both."""
_GLANCE_S, _GLANCES = 0.1, 100
"""Timeout [s] and number of waits for the first joint state; several, since time passes for a stopped process too."""


class Runtime:
    """One run. Call `start`, then `step` (lockstep) or `wait` until the run has ended, then `stop`.

    It serves `/set_mode`, `/reset` and, from the start to the end of the run, `/estop`.
    """

    def __init__(self, session: Session) -> None:
        if session.request.goals and session.config.control_modes[session.mode].planner is None:
            planning = [name for name, mode in session.config.control_modes.items() if mode.planner]
            remedy = f"--mode {' or --mode '.join(planning)}" if planning else "and this robot has none"
            raise NotSupported(f"--goal needs a mode with a planner: {remedy}")
        self.session = session
        for topic, type_name in Contract.from_config(session.config).topics.items():
            session.bus.expect(topic, *(_PICTURES if type_name in _PICTURES else (type_name,)))
        self.plan: LaunchPlan = build_plan(session)
        counted = self.plan.episodes_worker is not None or session.request.by_operator
        if session.request.episodes is not None and not counted:
            raise NotSupported(
                "--episodes counts a policy's episodes in simulation: it needs --sim and a mode with inference; "
                f"mode {session.mode} ends with --duration, --goal or Ctrl-C"
            )
        self._mode_components = self.plan.mode
        session.command_source = self.plan.mode.source
        self._started: list[Component] = []
        self._begun_ns = session.clock.now_ns()
        self._restore_hook: Callable[[], None] = lambda: None

    def start(self, on_start: Callable[[str], None] = lambda name: None) -> None:
        """Start every component once the components it needs are ready.

        If a component fails, those started before it are stopped. If Ctrl-C ends the run during the start, the started
        components are stopped and nothing is raised.

        Args:
            on_start: called with the name of each component before it starts.

        Raises:
            IbrobotError: the cause, with the component's name.
        """
        session = self.session
        self._watch_threads()
        if self.plan.without:
            session.log.warning("running without %s", self.plan.without)
        config = session.config
        for line in (*absent_models(config.absent_models), *unavailable_modes(config.unavailable)):
            session.log.warning("%s", line)
        session.bus.serve(ESTOP, lambda request: session.emergency_stop())
        session.bus.serve(CHECK_ESTOP, lambda request: session.check_stop())
        try:
            for component in self.plan.components:
                if component is self.plan.episodes_worker:
                    self._arrive()
                on_start(component.name)
                self._started.append(component)
                self._start(component)
            if self.plan.episodes_worker is None:
                self._arrive()
                session.begin_source()
                if not session.request.by_operator:  # one open-ended episode, from the robot's present state
                    session.episodes.begin()
            self._begun_ns = session.clock.now_ns()
            if session.goal_door is None and any(each.goals == "trajectory" for each in config.executors.values()):
                session.log.warning("goals of trajectories are limited, not checked: no plugin checks them")
        except BaseException as error:
            ended = session.finished.is_set()
            session.start_failed = True
            self.stop()
            self.raise_failure()  # e.g. control, which died while a camera started
            if ended and isinstance(error, ComponentFailed):
                return
            raise
        session.bus.serve(SET_MODE, lambda request: self.switch_mode(request.mode, request.stops, request.prompt))
        session.bus.serve(RESET, lambda request: self.reset(request.stops))

    def wait(self, timeout_s: float) -> bool:
        """Wait up to `timeout_s` [s] for the end of the run; return whether it has ended."""
        duration = self.session.request.duration_s
        if duration is not None and self.session.clock.now_ns() - self._begun_ns >= ns(duration):
            self.session.finish()
        return self.session.finished.wait(timeout_s)

    def step(self) -> bool:
        """Lockstep: run one control period with all work due in it; return whether the run has ended."""
        session = self.session
        clock = session.clock
        assert isinstance(clock, SteppedClock)
        now_ns = clock.advance(ns(1.0 / session.config.control.rate_hz))
        # A step may switch the mode, which removes components.
        for component in (each for each in self._started if each in self._started):
            try:
                component.step(now_ns)
            except Exception as error:  # noqa: BLE001 - a component that dies ends the run, with its cause
                session.fail(component.name, error)
        return self.wait(0.0)

    def switch_mode(self, name: str, stops: int | None = None, prompt: str = "") -> None:
        """Enter another mode: start its components, then change the owner of the joints within one tick.

        For the present mode, continue it if a reset made the robot hold; otherwise do nothing, unless its policy is
        given another prompt. A request waits for a mode switch or reset under way.

        Args:
            name: the mode.
            stops: as for `reset`.
            prompt: task of the mode's policy; empty: that of the robot YAML.

        Raises:
            IbrobotError: if there is no such mode, it has no policy for the prompt, its components do not start, or
                the robot is stopped, now or before this request's turn; the present mode continues.
        """
        session = self.session
        if name not in session.config.control_modes:
            raise NotSupported(f"no mode {name!r}; the modes are: {', '.join(session.config.control_modes)}")
        if (reason := session.config.unavailable.get(name)) is not None:
            raise PluginError(f"mode {name} is unavailable: {reason}")
        if session.faults:
            raise HardwareError(f"mode {name}: refused before a reset: {session.faults[-1]}")
        policy = session.config.control_modes[name].inference is not None
        if prompt and not policy:
            raise NotSupported(f"mode {name}: takes no prompt, since it has no policy")
        with self._changing(f"mode {name}", session.stops if stops is None else stops, policy):
            if prompt or name != session.mode:
                self._enter(name, prompt)
            elif session.held:
                self._go_on()

    def _enter(self, name: str, prompt: str) -> None:
        """Enter another mode."""
        session = self.session
        added = mode_components(session, name, self.plan.link, prompt)
        new = added.components()
        try:
            for component in new:
                self._start(component)
            self._change_owner(name)
        except BaseException:
            self._stop_all(new)
            raise
        session.episodes.end("unknown")
        previous = session.mode
        session.mode, session.command_source, session.held = name, added.source, False
        session.begin_source()
        old, self._mode_components = self._mode_components.components(), added
        self._started = [component for component in self._started if component not in old] + new
        self._stop_all(old)
        session.emit("ibrobot_mode_changed", mode=name, previous=previous)
        if not session.request.by_operator:
            session.episodes.begin()

    def reset(self, stops: int | None = None) -> str:
        """Clear faults and the emergency stop, and restart the mode at the measured positions.

        An autonomous mode does not restart: after a fault the robot holds until the operator enters the mode again.

        Args:
            stops: number of emergency stops that the operator knew of, see `ControlState.stops`; None: all so far.

        Returns:
            What the robot does now, and how to continue.

        Raises:
            IbrobotError: if the hardware, or a device that the mode needs, does not answer yet, or an emergency stop
                came that the operator did not know of. The robot stays stopped.
        """
        session = self.session
        stops = session.stops if stops is None else stops
        with self._changing("reset", stops):
            session.command_source.recover()
            session.end_source()
            try:
                stopped = bool(session.command(ClearFaults(stops))["cleared"])
            except BaseException:
                if not session.faults:  # the robot was not stopped, and its mode goes on
                    session.begin_source()
                raise
            session.held = session.command_source.autonomous and (stopped or session.held)
            try:
                session.begin_source()
            except IbrobotError as error:
                session.raise_fault(f"mode {session.mode} does not start over: {error}")
                raise
            then = f"holding: {session.to_go_on()}" if session.held else f"mode {session.mode} starts over"
            session.log.info("reset; %s", then)
            return f"reset; {then}"

    @contextmanager
    def _changing(self, what: str, stops: int, policy: bool = False) -> Iterator[None]:
        """Change the state of the run when nobody else does, at the request of a user who knew of `stops` stops.

        Args:
            what: the change, for messages.
            stops: as for `reset`.
            policy: whether it starts a policy.

        Raises:
            IbrobotError: if the run has ended, or there were more emergency stops, when its turn comes.
        """
        session = self.session
        with session.changing:
            if session.finished.is_set():
                raise NotSupported(f"{what}: refused, the run ends")
            if session.stops > stops:
                raise HardwareError(f"{what}: refused, an emergency stop came after it was requested")
            session.authority.taken_over(what, policy)
            yield

    def _go_on(self) -> None:
        """Enter the present mode again after a reset made the robot hold."""
        session = self.session
        session.command(SwitchMode(session.mode))
        session.held = False
        between_episodes = self.plan.episodes_worker in self._started and not session.episodes.running
        if not between_episodes:
            session.begin_source()
        session.log.info("mode %s goes on", session.mode)

    def stop(self) -> None:
        """Stop every component in reverse starting order, and the robot before those that send stops or may wait.

        Errors are logged, so that all are stopped.
        """
        session = self.session
        session.finish()
        session.stopping.set()
        for service in (SET_MODE, RESET):
            session.bus.unserve(service)
        if (worker := self.plan.episodes_worker) in self._started:
            self._started.remove(worker)
            self._stop_all([worker])
        session.episodes.end("unknown")
        changing = session.changing.acquire(timeout=_CHANGE_S)
        try:
            started, self._started = self._started, []
            control = next((i for i, each in enumerate(started) if isinstance(each, ControlComponent)), -1)
            first = [each for each in started[control + 1 :] if not (each.sends_stops or each.may_wait)]
            self._stop_all(first)
            self._halt()
            self._stop_all([each for each in started if each not in first])
        finally:
            if changing:
                session.changing.release()
            session.bus.unserve(ESTOP)
            session.bus.unserve(CHECK_ESTOP)
            self._restore_hook()

    def _halt(self) -> None:
        """Let control carry out the stop behaviour, while the components that can send an emergency stop still run."""
        session, stops = self.session, self.session.stops
        if not session.has_control:
            return
        with suppress(Exception):  # a bug or a death, which the end of control reports
            session.control.halt(unmoved=session.start_failed)
        if session.stops > stops:
            session.log.warning("emergency stop: the robot holds where it is, and the run ends")

    def raise_failure(self) -> None:
        """Raise the failure that ended the run, if any.

        Raises:
            ComponentFailed: with component and cause on one line.
        """
        if self.session.failure is not None:
            raise ComponentFailed(self.session.failure_text, exit_code(self.session.failure[1]))

    def summary(self) -> dict[str, Any]:
        """The summary as `--json` prints it, including facts from the first mode's command source."""
        session = self.session
        outcome = session.outcome
        report = session.control.report if session.has_control else {"loop": {}, "counters": {}}
        return {
            "robot": session.config.robot.name,
            "mode": session.mode,
            "simulated": session.config.simulated,
            "lockstep": session.request.lockstep,
            "seed": session.request.seed,
            "duration_s": round((session.clock.now_ns() - self._begun_ns) * 1e-9, 3),
            "episodes": outcome.episodes,
            "successes": outcome.successes,
            "unjudged": outcome.unjudged,
            "disturbed": outcome.disturbed,
            "goals_failed": outcome.goals_failed,
            "faults": outcome.faults,
            "faults_at_end": session.faults,
            "holding": outcome.holding,
            "loop": report["loop"],
            "counters": report["counters"],
            "rates_hz": {name: round(sensor.rate_hz, 2) for name, sensor in session.sensors.items()},
            "drops": session.bus.dropped(),
            "absent": {sensor.name: str(sensor.missing) for sensor in session.absent},
            **self.plan.mode.source.facts(),
        }

    def _start(self, component: Component) -> None:
        with _named(component):
            component.start()
            if isinstance(component, ControlComponent) and self.session.request.lockstep:
                component.step(self.session.clock.now_ns())

    def _stop_all(self, components: list[Component]) -> None:
        """Stop `components` in reverse order. Errors are logged, so that all are stopped."""
        for component in reversed(components):
            try:
                component.stop()
            except Exception as error:  # noqa: BLE001 - contained: the others must be stopped all the same
                self.session.log.error("%s did not stop cleanly: %s", component.name, error_text(error, "; "))
                if isinstance(component, ControlComponent) and self.session.failure is None:
                    self.session.failure = component.name, error

    def _change_owner(self, mode: str) -> None:
        """Switch the mode of control; if control refuses, the present mode continues.

        Simulated episodes belong to the first mode and end with it.
        """
        session = self.session
        worker = self.plan.episodes_worker if self.plan.episodes_worker in self._started else None
        if worker is not None:
            worker.stop()
        session.end_source()
        try:
            session.command(SwitchMode(mode))
        except BaseException:
            session.begin_source()
            if worker is not None:
                worker.start()
            raise
        if worker is not None:
            self._started.remove(worker)

    def _await_state(self) -> None:
        session = self.session
        states = session.watch_states()
        for _ in range(_GLANCES):
            if session.state is not None:
                return
            self.raise_failure()
            states.get(_GLANCE_S)
        raise HardwareError("control is ready but sends no joint states")

    def _arrive(self) -> None:
        """Wait until the robot is in its mode, and has been seen there.

        Raises:
            ComponentFailed: if it does not arrive, e.g. after an emergency stop.
        """
        control = next(each for each in self._started if isinstance(each, ControlComponent))
        with _named(control):
            control.arrive()
        self._await_state()

    def _watch_threads(self) -> None:
        """Have the run end with any thread that dies of an exception: it may be one that a STOP goes through."""
        before, hook = threading.excepthook, self._end_with

        def restore() -> None:
            if threading.excepthook == hook:  # the hook of a later run stays
                threading.excepthook = before

        threading.excepthook = hook
        self._restore_hook = restore

    def _end_with(self, dead: threading.ExceptHookArgs) -> None:
        name = dead.thread.name if dead.thread is not None else "a thread"
        self.session.fail(f"thread {name!r}", dead.exc_value or dead.exc_type())


@contextmanager
def _named(component: Component) -> Iterator[None]:
    """Put the component's name before an error."""
    try:
        yield
    except Exception as error:
        raise ComponentFailed(f"{component.name}: {error_text(error)}", exit_code(error)) from error
