"""Corrections: within an episode, an operator takes the robot from a policy and gives it back."""

from __future__ import annotations

import queue
from collections.abc import Mapping
from typing import Any, Protocol, override

import attrs
from ibrobot_provenance.recorded_names import COMMANDER, HANDOVER, OPERATOR, POLICY
from ibrobot_terminal import HeldKeys

from ibrobot_core.api import (
    NotSupported,
    String,
    TeleopCommand,
    TeleopError,
    Vector,
    documented,
    option,
    seconds,
)
from ibrobot_core.app import (
    CONTROL,
    ControlMode,
    ControlState,
    OperatorDevices,
    Service,
    SourceWorker,
    StreamingRun,
)
from ibrobot_data.handover import Handover
from ibrobot_data.options import EpisodesOptions, has_button, options_of


@documented
@attrs.frozen
class Intervene:
    """A request to `/intervene`."""

    take: bool | None = option(None, help="true: take the robot from the policy; false: give it back; else: toggle")


INTERVENE = Service(
    "/intervene", Intervene, str, "Take the robot from its policy; answers who commands from then on.", alone="take"
)
_RELEASE_S = 0.2
"""Longest time between two repeats of a held key [s]."""
_ANSWER_S = 60.0
"""Longest hold while the policy does not answer; later its setpoints count as stale [s]."""


class Interruptible(Protocol):
    """The source that runs the policy."""

    name: str

    def begin(self, seed: int) -> None:
        """Start."""

    def end(self) -> None:
        """Stop."""

    def recover(self) -> None:
        """Recover from a failure."""

    def facts(self) -> Mapping[str, Any]:
        """Facts for the summary of the run."""

    def described(self) -> Mapping[str, str]:
        """Name and weights of the policy."""

    def suspend(self) -> None:
        """Send no plan until `resume`."""

    def resume(self, position: Vector) -> None:
        """Ask the policy for a plan that begins at a position [rad], shape (A,)."""


class Corrections(SourceWorker):
    """Lets an operator take the robot from a policy and give it back, any number of times.

    At a takeover the policy's plan is dropped, the arm brakes and holds, and devices with motors are driven to its
    pose. The operator's first command ends the handover; then the robot follows the devices, starting from its present
    position. When the operator gives it back, it brakes again, and the policy is asked for a new plan, which begins at
    the held position. The policy's observations are sampled throughout.

    `/commander` says who commands at each state of control: `policy`, `operator`, or `handover` while neither does.

    Args:
        session: the run.
        mode: the mode, with `inference.intervene`.
        policy: runs the policy.
    """

    session: StreamingRun
    autonomous = True
    sends_stops = True
    urgent = True

    def __init__(self, session: StreamingRun, mode: ControlMode, policy: Interruptible) -> None:
        assert mode.inference is not None
        config = session.config
        self._devices = OperatorDevices(session, mode.inference.devices)
        super().__init__(session, mode, f"takeovers by {self._devices}", (CONTROL, policy.name))
        self.name = f"operator:{mode.name}"
        self._policy = policy
        self._options: EpisodesOptions = options_of(config)
        moved = {joint for name in mode.executors for joint in config.executors[name].joints}
        self._arm = Handover(session, tuple(joint for joint in config.robot.joint_names if joint in moved))
        self._keys: queue.SimpleQueue[str] | None = None
        self._held = HeldKeys(_RELEASE_S)
        self._commander = POLICY
        self._taken = False
        """Whether the operator has or is about to get the robot."""
        self._aligned = True
        """Whether the devices may command: those with motors are at the robot's pose."""
        self._waiting = False
        """Whether the policy was asked to continue and has not commanded yet."""
        self._engaged = False
        """Whether the devices commanded positions at the last state."""
        self._takeovers = 0
        self._commanded_ns = 0
        """How long the operator commanded [ns]."""
        self._changed_ns = 0

    @override
    def described(self) -> Mapping[str, str]:
        return self._policy.described()

    @override
    def setup(self) -> None:
        session = self.session
        self.on_end.callback(self._devices.disconnect)
        self._devices.connect()
        self._states = session.watch_states()
        session.on_state.append(self._label)
        self.on_end.callback(session.on_state.remove, self._label)
        self._keys = session.request.keys() if session.request.keys is not None else None
        assert self.mode.inference is not None
        by_button = has_button(session, self.mode.inference.devices.values(), "intervention")
        if self._keys is None and self._options.takeover == "button" and not by_button:
            session.log.warning(
                "without a terminal and a button of %s, only the service %s takes the robot from the policy; "
                "`episodes: {takeover: deadman}` lets the deadman take it, too",
                self._devices,
                INTERVENE.name,
            )
        self._publish()

    @override
    def recover(self) -> None:
        with self._devices.pulse.paused(), self.lock:
            self._devices.recover()
            self._policy.recover()

    @override
    def begin_mode(self, seed: int) -> None:
        self._arm.begin()
        self._devices.activate(self.session.measured())
        self._taken = self._waiting = self._engaged = False
        self._set(POLICY)
        self._held.take(self._keys, self.session.clock.now_ns())
        self._held.forget()
        self._policy.begin(seed)
        self.session.bus.serve(INTERVENE, lambda request: self.intervene(request.take))

    @override
    def end_mode(self) -> None:
        self.session.bus.unserve(INTERVENE)
        self._policy.end()
        self._set(POLICY)
        self.session.commander = ""

    def intervene(self, take: bool | None = None) -> str:
        """Take the robot from the policy, give it back, or toggle. Returns who commands from then on.

        Raises:
            NotSupported: if the mode has ended.
        """
        with self.lock:
            if not self.active:
                raise NotSupported(f"mode {self.mode.name} is not running, so its policy cannot be interrupted")
            if self.session.faults:
                raise NotSupported(f"reset the robot before taking it from the policy: {self.session.faults[-1]}")
            self._change(not self._taken if take is None else take)
            return self._commander

    @override
    def work(self, timeout_s: float) -> None:
        self._devices.pulse.beat()
        if self._states.get(timeout_s) is None:
            return
        with self.lock:
            self._held.take(self._keys, self.session.clock.now_ns())
            if self.active:
                self._tick(int(self._is_key_pressed()))

    @override
    def help(self) -> str:
        does = "give the robot back to the policy" if self._taken else "take the robot from the policy"
        return f"{self._options.takeover_key}  {does}\n{self._devices.help()}"

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        return [("takeovers", f"{self._takeovers}; the operator commanded for {seconds(self._commanded_ns):.1f} s")]

    @override
    def facts(self) -> dict[str, object]:
        return {
            **self._policy.facts(),
            "takeovers": self._takeovers,
            "operator_s": round(seconds(self._commanded_ns), 3),
        }

    def _is_key_pressed(self) -> bool:
        """Whether the key for takeovers was pressed.

        Anything that may be a press takes the robot at once. Only a certain press gives it back, not the repeats of a
        held key.
        """
        key, held = self._options.takeover_key, self._held
        if self._taken:
            return key in held.presses
        pressed = key in held.touched and ("repeat", key) not in held.events
        if pressed:
            held.forget()
        return pressed

    def _tick(self, presses: int) -> None:
        session = self.session
        state = session.state
        assert state is not None
        self._arm.see(state)
        try:
            command = self._devices.read(session.measured())
            self._press(command, presses)
            self._command(command)
        except TeleopError as error:
            self.end()
            session.raise_fault(str(error))

    def _press(self, command: TeleopCommand, presses: int) -> None:
        """Act on keys and buttons."""
        session = self.session
        for event in command.events:
            if event == "intervention":
                presses += 1
            else:
                session.pass_on(event)
        if session.faults:
            pass  # a handover that began now would be one after the reset
        elif presses % 2:
            self._change(not self._taken)
        elif self._options.takeover == "deadman" and bool(command.positions) != self._engaged:
            self._change(bool(command.positions), engaged=True)
        self._engaged = bool(command.positions)

    def _change(self, take: bool, *, engaged: bool = False) -> None:
        """Take the robot, or give it back; `engaged` if the operator's deadman is pressed already."""
        if take == self._taken:
            return
        self._taken = take
        if take:
            self._policy.suspend()  # from here on it sends no plan that could replace the braking
            self._takeovers += 1
            self._aligned = engaged
        self._arm.brake()
        self._waiting = False
        self._set(HANDOVER)
        self.session.log.info("the operator takes the robot" if take else "the policy gets the robot back")

    def _command(self, command: TeleopCommand) -> None:
        """Send what the operator commands, or hold for the handover."""
        if self._taken:
            if self._commander == HANDOVER and not self._may_command():
                self._arm.hold()
            elif command.positions and (self._arm.at_rest or not self._arm.holds):
                self._set(OPERATOR)
                self._arm.follow(command.positions)
            elif self._arm.holds:
                self._arm.hold()
            else:  # the deadman is released
                self._arm.brake()
        elif self._commander == HANDOVER:
            self._give_back()

    def _may_command(self) -> bool:
        """Whether the arm holds, and the devices may command it."""
        if not self._arm.at_rest:
            return False
        if not self._aligned and self._devices.approach(self.session.measured()):
            self._aligned = True
            self._devices.activate(self.session.measured())
            return False
        return self._aligned

    def _give_back(self) -> None:
        """Ask the policy for a plan once the arm holds. The policy commands from the plan's arrival."""
        acting = self.session.acting
        if not self._waiting and self._arm.at_rest:
            self._arm.hold(_ANSWER_S)
            self._waiting = True
            self._devices.activate(self.session.measured())
            self._policy.resume(self._arm.position)
        elif self._waiting and acting is not None and acting.dispatch.plan_length:
            self._set(POLICY)

    def _set(self, commander: str) -> None:
        now_ns = self.session.clock.now_ns()
        if self._commander == OPERATOR:
            self._commanded_ns += now_ns - self._changed_ns
        self._commander, self._changed_ns = commander, now_ns
        self.session.commander = commander
        if not self.active:  # before the first state of an episode
            self._publish()

    def _label(self, state: ControlState) -> None:
        """Publish who commanded at a state, in the thread that publishes the state: `work` may be late."""
        if self.active:
            self._publish()

    def _publish(self) -> None:
        self.session.bus.publish(COMMANDER, String(self._commander), latched=True)
