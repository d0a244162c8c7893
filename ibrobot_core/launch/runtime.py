"""The runtime: starts a plan's components in order, runs them until the run ends, and stops them in reverse."""

from __future__ import annotations

from collections.abc import Callable
from types import NoneType
from typing import Any

import attrs

from ibrobot_core.clock import SteppedClock
from ibrobot_core.component import Component, Worker, error_line, error_text, exit_code
from ibrobot_core.config.missing import absent_models, unavailable_modes
from ibrobot_core.errors import ComponentFailed, HardwareError, NotSupported, PluginError
from ibrobot_core.launch.control import ControlComponent
from ibrobot_core.launch.plan import LaunchPlan, build_plan, mode_components
from ibrobot_core.launch.session import Session
from ibrobot_core.options import documented, option
from ibrobot_core.services import NoRequest, Service
from ibrobot_core.units import ns


@documented
@attrs.frozen
class SetMode:
    """A request to `/set_mode`."""

    mode: str = option(help="a control mode of the robot YAML")


SET_MODE = Service("/set_mode", SetMode, NoneType, "Enter another control mode.", alone="mode")
RESET = Service("/reset", NoRequest, str, "Clear faults and the emergency stop; answers with what the robot does now.")
ESTOP = Service("/estop", NoRequest, NoneType, "Stop the robot at once, and hold until a reset.")
_GLANCE_S, _GLANCES = 0.1, 100
"""Timeout [s] and number of waits for the first joint state; several, since time passes for a stopped process too."""


class Runtime:
    """One run. Call `start`, then `step` (lockstep) or `wait` until the run has ended, then `stop`.

    It serves `/set_mode`, `/reset` and `/estop`.
    """

    def __init__(self, session: Session) -> None:
        if session.request.goals and session.config.control_modes[session.mode].planner is None:
            planning = [name for name, mode in session.config.control_modes.items() if mode.planner]
            remedy = f"--mode {' or --mode '.join(planning)}" if planning else "and this robot has none"
            raise NotSupported(f"--goal needs a mode with a planner: {remedy}")
        self.session = session
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
        if self.plan.without:
            session.log.warning("running without %s", self.plan.without)
        config = session.config
        for line in (*absent_models(config.absent_models), *unavailable_modes(config.unavailable)):
            session.log.warning("%s", line)
        try:
            for component in self.plan.components:
                on_start(component.name)
                self._started.append(component)
                self._start(component)
            self._begun_ns = session.clock.now_ns()
            if self.plan.episodes_worker is None:
                self._begin_mode()
        except BaseException as error:
            ended = session.finished.is_set()
            session.start_failed = True
            self.stop()
            self.raise_failure()  # e.g. control, which died while a camera started
            if ended and isinstance(error, ComponentFailed):
                return
            raise
        session.bus.serve(SET_MODE, lambda request: self.switch_mode(request.mode))
        session.bus.serve(RESET, lambda _: self.reset())
        session.bus.serve(ESTOP, self._estop)

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

    def switch_mode(self, name: str) -> None:
        """Enter another mode: start its components, then change the owner of the joints within one tick.

        For the present mode, continue it if a reset made the robot hold; otherwise do nothing.

        Raises:
            IbrobotError: if there is no such mode or its components do not start; the present mode continues.
        """
        session = self.session
        if name not in session.config.control_modes:
            raise NotSupported(f"no mode {name!r}; the modes are: {', '.join(session.config.control_modes)}")
        if (reason := session.config.unavailable.get(name)) is not None:
            raise PluginError(f"mode {name} is unavailable: {reason}")
        if name == session.mode:
            if session.held:
                self._go_on()
            return
        added = mode_components(session, name, self.plan.link)
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

    def reset(self) -> str:
        """Clear faults and the emergency stop, and restart the mode at the measured positions.

        An autonomous mode does not restart: after a fault the robot holds until the operator enters the mode again.

        Returns:
            What the robot does now, and how to continue.

        Raises:
            IbrobotError: if the hardware, or a device that the mode needs, does not answer yet.
        """
        session = self.session
        session.command_source.recover()
        session.command_source.end()
        stopped = bool(session.command("reset")["cleared"])
        session.held = session.command_source.autonomous and (stopped or session.held)
        session.begin_source()
        then = f"holding: {session.to_go_on()}" if session.held else f"mode {session.mode} starts over"
        session.log.info("reset; %s", then)
        return f"reset; {then}"

    def _estop(self, request: NoRequest) -> None:
        self.session.control.call("estop")

    def _go_on(self) -> None:
        """Enter the present mode again after a reset made the robot hold."""
        session = self.session
        session.command("switch_mode", mode=session.mode)
        session.held = False
        between_episodes = self.plan.episodes_worker in self._started and not session.episodes.running
        if not between_episodes:
            session.begin_source()
        session.log.info("mode %s goes on", session.mode)

    def stop(self) -> None:
        """Stop every component in reverse starting order. Errors are logged, so that all are stopped."""
        session = self.session
        session.finish()
        for service in (SET_MODE, RESET, ESTOP):
            session.bus.unserve(service)
        started, self._started = self._started, []
        if (worker := self.plan.episodes_worker) in started:
            started.remove(worker)
            self._stop_all([worker])
        session.episodes.end("unknown")
        self._stop_all(started)

    def raise_failure(self) -> None:
        """Raise the failure that ended the run, if any.

        Raises:
            ComponentFailed: with component and cause on one line.
        """
        if self.session.failure is not None:
            failure = ComponentFailed(self.session.failure_text)
            failure.exit_code = exit_code(self.session.failure[1])
            raise failure

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
            "goals_failed": outcome.goals_failed,
            "faults": outcome.faults,
            "holding": outcome.holding,
            "loop": report["loop"],
            "counters": report["counters"],
            "rates_hz": {name: round(sensor.rate_hz, 2) for name, sensor in session.sensors.items()},
            "drops": session.bus.dropped(),
            "absent": {sensor.name: str(sensor.missing) for sensor in session.absent},
            **self.plan.mode.source.facts(),
        }

    def _start(self, component: Component) -> None:
        try:
            if isinstance(component, Worker):
                component.given_up = self.session.finished
            component.start()
            if isinstance(component, ControlComponent) and self.session.request.lockstep:
                component.step(self.session.clock.now_ns())
        except Exception as error:
            failure = ComponentFailed(f"{component.name}: {error_text(error)}")
            failure.exit_code = exit_code(error)
            raise failure from error

    def _stop_all(self, components: list[Component]) -> None:
        """Stop `components` in reverse order. Errors are logged, so that all are stopped."""
        for component in reversed(components):
            try:
                component.stop()
            except Exception as error:  # noqa: BLE001 - contained: the others must be stopped all the same
                self.session.log.error("%s did not stop cleanly: %s", component.name, error_line(error))
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
            session.command("switch_mode", mode=mode)
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

    def _begin_mode(self) -> None:
        """Begin a mode without simulated episodes: one open-ended episode from the robot's present state."""
        session = self.session
        self._await_state()
        assert session.state is not None
        session.generation = session.state.generation
        session.begin_source()
        if not session.request.by_operator:
            session.episodes.begin()
