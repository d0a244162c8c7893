"""The host's side of control, with one interface for a loop in its own process or, in lockstep, in this process."""

from __future__ import annotations

import itertools
import logging
import os
import queue
import select
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, override

from ibrobot_core.child import Child, is_stopped
from ibrobot_core.clock import RealClock, SteppedClock
from ibrobot_core.component import raise_thread_priority
from ibrobot_core.config import RobotConfig
from ibrobot_core.control import commands
from ibrobot_core.control.core import ControlCore
from ibrobot_core.control.link import LinkLayout, SharedMemory
from ibrobot_core.control.timing import REPORT_TICKS, TOO_BUSY, Punctuality
from ibrobot_core.errors import ComponentFailed, HardwareError, IbrobotError
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord
from ibrobot_core.memory import create_memory
from ibrobot_core.plugins import Registry

_START_TIMEOUT_S = 60.0
_BEAT_S = 0.05
"""Longest time between two signs of life to control [s]."""
_GLANCE_S = 0.1
"""Interval at which a start checks whether it was given up."""
_HALT_GLANCE_S = 0.02
"""Interval at which `halt` asks whether the robot has stopped."""
_REPLY_TIMEOUT_S = 5.0
_STOP_TIMEOUT_S = 15.0
"""Time after which a control process that has not ended is killed; moving to a stop pose takes up to 10 s."""
_GONE = "the control process is gone"
_STOPS = (commands.EmergencyStop, commands.RaiseFault)
"""Commands sent to a control process that does not run at present, since they still matter once it runs again."""
_SLOW = (commands.ClearFaults, commands.ResetEpisode, commands.SwitchMode)
"""Commands during which control may be silent, e.g. while hardware is set up again."""

_LOG = logging.getLogger("ibrobot")

OnState = Callable[[ControlState], None]
OnEvent = Callable[[Mapping[str, Any]], None]


class ControlHost(ABC):
    """Starts control, sends it plans and commands, and forwards its states and events.

    Attributes:
        signals: topic and size of each hardware signal; known after `start`.
        report: the last `loop` and `counters` reported by control.
        refused: real-time settings refused by the machine, one line each.
        holding: parts that held torque when control ended, and how to switch it off, one line each.
        stops: number of emergency stops in this run, by the newest state or answer.
        generation: the generation that began when the robot arrived; see `arrive`.
    """

    def __init__(self, on_state: OnState, on_event: OnEvent) -> None:
        self._on_state = on_state
        self._on_event = on_event
        self.signals: list[tuple[str, int]] = []
        self.report: dict[str, Any] = {"loop": Punctuality().summary(), "counters": {}}
        self.refused: list[str] = []
        self.holding: list[str] = []
        self.stops = 0
        self.generation = 0

    @property
    @abstractmethod
    def running(self) -> bool:
        """Whether commands reach control, now or as soon as it ticks."""

    @abstractmethod
    def start(self) -> None:
        """Connect the hardware and start ticking. From then on, `call` may stop the robot.

        Raises:
            IbrobotError: e.g. if the hardware does not connect.
        """

    @abstractmethod
    def call(self, command: commands.Command) -> Mapping[str, Any]:
        """Execute a command and return its answer, with the `generation` valid from now on.

        Raises:
            HardwareError: if the command is refused.
            ComponentFailed: if control has died.
        """

    @abstractmethod
    def write_plan(self, plan: PlanRecord) -> None:
        """Replace the plan."""

    @abstractmethod
    def arrive(self) -> None:
        """Have the robot move to its startup pose, and wait until it has arrived, and entered its mode.

        Raises:
            IbrobotError: if it has not arrived, e.g. after an emergency stop.
        """

    @abstractmethod
    def halt(self, *, unmoved: bool = False) -> None:
        """Stop the robot with the configured behaviour, and wait for the end; `call` may still brake it.

        Args:
            unmoved: as for `stop`.

        Raises:
            ComponentFailed: if control has died.
        """

    @abstractmethod
    def stop(self, *, unmoved: bool = False) -> None:
        """Stop the robot with the configured behaviour, unless it has halted, and end control. Safe to call twice.

        Args:
            unmoved: the run failed before anything moved the robot: the torque that its start put on goes off again.
        """


class InlineControl(ControlHost):
    """Control in the calling thread, for lockstep; `step` runs one tick."""

    def __init__(
        self, config: RobotConfig, registry: Registry, clock: SteppedClock, seed: int, on_state: OnState,
        on_event: OnEvent,
    ) -> None:  # fmt: skip
        super().__init__(on_state, on_event)
        self._core = ControlCore.of(config, registry, clock, seed)
        self._clock = clock
        self._mode = config.default_control_mode
        self._punctuality = Punctuality()
        self._started = False

    @property
    @override
    def running(self) -> bool:
        return self._started

    @override
    def start(self) -> None:
        try:
            self._core.start(self._mode)
        except BaseException:
            self._close()
            raise
        self.signals = [(signal.topic, signal.size) for signal in self._core.signals]
        self._started = True

    @override
    def arrive(self) -> None:
        self._core.begin_startup()
        while not self._core.arrived():
            self._clock.advance(self._core.period_ns)
            self.step()
        self.generation = self._core.generation

    def step(self) -> None:
        """Run one tick at the clock's time."""
        state = self._core.tick()
        self.stops = state.stops
        self._on_state(state)
        self._punctuality.tick(self._clock.now_ns(), 0, 0)
        if state.tick % REPORT_TICKS == 0:
            self._report()
        while self._core.events:
            self._on_event(self._core.events.popleft())

    @override
    def call(self, command: commands.Command) -> Mapping[str, Any]:
        reply = self._core.handle(command)
        self.stops = reply["stops"]
        return commands.raise_error(reply)

    @override
    def write_plan(self, plan: PlanRecord) -> None:
        self._core.set_plan(plan)

    @override
    def halt(self, *, unmoved: bool = False) -> None:
        if not self._started:
            return
        self._core.begin_stop(unmoved=unmoved)
        while not self._core.stopped:
            self._clock.advance(self._core.period_ns)
            self.step()

    @override
    def stop(self, *, unmoved: bool = False) -> None:
        if not self._started:
            return
        try:
            self.halt(unmoved=unmoved)
        finally:
            self._started = False
        self._report()
        self._close()

    def _close(self) -> None:
        self._core.close()
        self.holding = self._core.holding()

    def _report(self) -> None:
        self.report = {"loop": self._punctuality.summary(), "counters": self._core.counters()}


class ControlClient(ControlHost):
    """Control in a separate process. A thread receives its states and events and detects its death.

    Args:
        config: the robot YAML.
        clock: the clock of the run.
        seed: seed for simulated hardware.
        on_state: called with each state, in that thread.
        on_event: called with each event, in that thread.
        on_death: called when the process dies.
        given_up: set to abort `start` and `arrive`.
        aftermath: text appended to the report of its death.
    """

    def __init__(
        self, config: RobotConfig, clock: RealClock, seed: int, on_state: OnState, on_event: OnEvent,
        on_death: Callable[[ComponentFailed], None], *, given_up: threading.Event | None = None, aftermath: str = "",
    ) -> None:  # fmt: skip
        super().__init__(on_state, on_event)
        self._config = config
        self._clock = clock
        self._order = {
            "document": config.complete,
            "source": str(config.source),
            "sim": config.simulated,
            "seed": seed,
            "mode": config.default_control_mode,
            "epoch_offset_ns": clock.epoch_offset_ns,
        }
        self._on_death = on_death
        self._given_up = given_up or threading.Event()
        self._aftermath = aftermath
        self._replies: dict[int, queue.SimpleQueue[Mapping[str, Any]]] = {}
        self._slow: set[int] = set()
        """Ids of the pending commands of `_SLOW`."""
        self._silence = ""
        """What is wrong while control does not run; empty while it does."""
        self._generation = 0
        self._ids = itertools.count(1)
        self._stopping = False
        self._child: Child | None = None
        self._memory: SharedMemory | None = None
        self._thread: threading.Thread | None = None
        self._arrived = threading.Event()

    @property
    @override
    def running(self) -> bool:
        return self._child is not None

    @property
    def pid(self) -> int | None:
        """The process id of control, None before `start`."""
        return self._child.pid if self._child is not None else None

    @override
    def start(self) -> None:
        memory = create_memory()
        self._wake, wake = os.pipe()
        child = self._child = Child("ibrobot_core.control.process", self._order, memory, wake, end_s=_STOP_TIMEOUT_S)
        os.close(wake)
        self._descriptor = memory
        try:
            self._await_ready(child)
        except IbrobotError:
            child.channel.close()  # a process that is not ready yet stops once it is
            self._end(child)
            self._let_go(_GONE)
            raise
        self._thread = threading.Thread(target=self._receive, args=(child,), name="control link", daemon=True)
        self._thread.start()

    def _await_ready(self, child: Child) -> None:
        deadline_s = time.monotonic() + _START_TIMEOUT_S
        while self._memory is None:
            try:
                message = child.wait(_GLANCE_S)
            except ComponentFailed as death:
                if child.failure is None:
                    text = f"the control process died while starting ({death}){self._aftermath}"
                    raise ComponentFailed(text) from None
                self.holding = child.failure.holding
                failure = HardwareError(child.failure.error)
                failure.exit_code = child.failure.exit_code
                raise failure from None
            if self._given_up.is_set():
                raise ComponentFailed("given up while control started")
            if time.monotonic() > deadline_s:
                raise ComponentFailed(f"the control process was not ready after {_START_TIMEOUT_S:.0f} s")
            if message is not None and message["event"] == "ready":
                self.signals = [(topic, size) for topic, size in message["signals"]]
                self.refused = message["refused"]
                layout = LinkLayout(len(self._config.robot.joints), sum(size for _, size in self.signals))
                self._memory = SharedMemory(self._descriptor, layout)
            elif message is not None:
                self._take(message)

    @override
    def call(self, command: commands.Command) -> Mapping[str, Any]:
        if self._child is None or (self._silence and not isinstance(command, _STOPS)):
            raise ComponentFailed(self._silence or _GONE)
        channel = self._child.channel
        number = next(self._ids)
        answer: queue.SimpleQueue[Mapping[str, Any]] = queue.SimpleQueue()
        self._replies[number] = answer
        self._slow |= {number} if isinstance(command, _SLOW) else set()
        try:
            channel.send(commands.encode(command, number))
            if channel.closed or self._silence:
                raise ComponentFailed(self._silence or _GONE)
            reply = answer.get(timeout=_REPLY_TIMEOUT_S)
            if "gone" in reply:
                raise ComponentFailed(reply["gone"])
            return commands.raise_error(reply)
        except queue.Empty:
            name = type(command).__name__
            raise ComponentFailed(f"control did not answer {name} within {_REPLY_TIMEOUT_S:.0f} s") from None
        finally:
            del self._replies[number]
            self._slow.discard(number)

    def raise_fault(self, fault: str) -> None:
        """Have control brake and hold because of a fault, without waiting for its answer."""
        if self._child is not None:
            self._child.channel.send(commands.encode(commands.RaiseFault(fault), 0))

    @override
    def arrive(self) -> None:
        self.call(commands.BeginStartup())
        while not self._arrived.wait(_GLANCE_S):
            if self._given_up.is_set():
                raise ComponentFailed("given up while the robot moved to its startup pose")

    @override
    def halt(self, *, unmoved: bool = False) -> None:
        deadline_s = time.monotonic() + _STOP_TIMEOUT_S
        while self.running and not self.call(commands.Halt(unmoved))["halted"]:
            if time.monotonic() >= deadline_s:
                return
            time.sleep(_HALT_GLANCE_S)

    @override
    def write_plan(self, plan: PlanRecord) -> None:
        if self._memory is not None:
            self._memory.write_plan(plan)

    @override
    def stop(self, *, unmoved: bool = False) -> None:
        if self._child is None:
            return
        self._stopping = True
        self._child.channel.send(commands.encode(commands.Halt(unmoved, ends=True), 0))
        self._child.resume()
        self._end(self._child)

    def _end(self, child: Child) -> None:
        """Wait for the process to end and release the shared resources."""
        if child.end():
            _LOG.error("the control process did not end within %g s: killed%s", _STOP_TIMEOUT_S, self._aftermath)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        child.channel.close()
        os.close(self._wake)
        if self._memory is not None:
            self._memory.close()
            self._memory = None
        else:
            os.close(self._descriptor)
        self._child = None

    def _receive(self, child: Child) -> None:
        try:
            self._pass_on(child)
        except BaseException as error:  # noqa: BLE001 - reported to the run, which cannot go on without states
            self._on_death(ComponentFailed(f"control's states cannot be passed on ({type(error).__name__}: {error})"))
            self._let_go("control's states cannot be passed on")
            return
        if child.failure is not None:
            self.holding = child.failure.holding
        if not self._stopping:
            self._on_death(self._death(child))
        # Wake waiting callers only afterwards, so that the cause is reported and not its consequence.
        self._let_go(_GONE)

    def _let_go(self, why: str) -> None:
        """Have waiting callers raise `why`."""
        for number in list(self._replies):
            self._take({"reply": number, "gone": why})

    def _death(self, child: Child) -> ComponentFailed:
        if child.failure is None or self._arrived.is_set():
            return ComponentFailed(f"the control process died ({child.cause()}){self._aftermath}")
        # The robot did not arrive, and control says why.
        return ComponentFailed(child.failure.error, child.failure.exit_code)

    def _pass_on(self, child: Child) -> None:
        """Forward states and messages, and give signs of life, until control has ended."""
        assert self._memory is not None
        raise_thread_priority()  # its delay is taken for a host that is stopped
        heard_s = time.monotonic()
        while child.alive and not child.channel.closed:
            ready, _, _ = select.select([self._wake, child.channel.fileno()], [], [], _BEAT_S)
            if self._wake in ready:
                os.read(self._wake, 65536)
            self._forward(child)
            self._memory.beat()
            if ready:
                heard_s = time.monotonic()
            self._note_silence(child, time.monotonic() - heard_s)
        self._forward(child)

    def _forward(self, child: Child) -> None:
        """Forward the messages and states that have arrived."""
        assert self._memory is not None
        # Read states after the socket, so that everything measured before an answer is published before the answer.
        messages = child.receive()
        for state in self._memory.read_states():
            self._generation, self.stops = state.generation, max(self.stops, state.stops)
            self._on_state(state)
        for message in messages:
            self._take(message)

    def _note_silence(self, child: Child, silent_s: float) -> None:
        """Report control as stopped or blocked after `control.peer_timeout`; meanwhile commands are refused."""
        if silent_s < self._config.control.peer_timeout:
            if self._silence:
                self._silence = ""
                _LOG.warning("the control process %d runs again", child.pid)
        elif not (self._silence or self._stopping):
            stopped = is_stopped(child.pid)
            if stopped or not self._slow:
                self._silence = self._describe_silence(child.pid, silent_s, stopped=stopped)
                self._on_event(
                    {
                        "event": "fault",
                        "fault": self._silence,
                        "then": "keeps the last command of its motors",
                        "stamp_ns": self._clock.now_ns(),
                        "generation": self._generation,
                    }
                )
                # Whatever it was doing, it does not go on with it unasked.
                self.raise_fault("the control process was silent")
                self._let_go(self._silence)

    def _describe_silence(self, pid: int, silent_s: float, *, stopped: bool) -> str:
        what = "is stopped" if stopped else f"has been silent for {silent_s * 1e3:.0f} ms"
        if self._config.simulated and not stopped:
            return f"the control process {pid} {what}; {TOO_BUSY}"
        ways = ["Ctrl-C ends the run"] if self._config.simulated else ["switch off the power of its motors"]
        ways += [f"`kill -CONT {pid}` continues the process"] if stopped else []
        return f"the control process {pid} {what}, and STOP does not reach the robot: {', or '.join(ways)}"

    def _take(self, message: Mapping[str, Any]) -> None:
        if "reply" in message:
            number, self.stops = message["reply"], max(self.stops, message.get("stops", 0))
            waiting = self._replies.get(number) if isinstance(number, int) else None
            if waiting is not None:
                waiting.put(message)
        elif message["event"] == "arrived":
            self.generation = message["generation"]
            self._arrived.set()
        elif message["event"] in ("report", "stopped"):
            self.report = {"loop": message["loop"], "counters": message["counters"]}
            self.holding = message.get("holding", [])
        else:
            self._on_event(message)
