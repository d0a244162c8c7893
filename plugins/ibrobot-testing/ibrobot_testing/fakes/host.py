"""Fakes of components in the host: sensor, teleoperation device, policy, engine, source, viewer.

`ibrobot plugins new` begins with one of them: each stands alone, also where two are alike.
"""

from __future__ import annotations

from typing import override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    Context,
    Engine,
    Frame,
    Header,
    Image,
    Imu,
    JointReading,
    Message,
    OperatorEvent,
    Policy,
    PolicySpec,
    Sensor,
    SensorError,
    Teleop,
    TeleopCommand,
    TeleopError,
    Tensors,
    Vector3,
    Viewer,
    ns,
    seconds,
)
from ibrobot_core.app import ControlMode, SourceWorker, StreamingRun, Subscription


class FakeSensor(Sensor):
    """A camera that captures an image at every control period of the clock.

    Args:
        ctx: provides the clock.
        width: width of the images [px].
        height: height of the images [px].
    """

    message_type: type[Message] = Image

    def __init__(self, ctx: Context, width: int = 8, height: int = 6) -> None:
        self.topic = f"/camera/{ctx.name}/image_raw"
        self._ctx = ctx
        self._size = (height, width)
        self._open = False
        self._last_ns = -1
        self._ends_ns: int | None = None

    def silence(self) -> None:
        """The device stops capturing."""
        self._ends_ns = self._ctx.clock.now_ns()

    @override
    def open(self) -> None:
        self._open = True

    @override
    def read(self, timeout_s: float) -> Image | None:
        if not self._open:
            raise SensorError(f"{self._ctx.name} is not open")
        clock, period_ns = self._ctx.clock, self._ctx.period_ns
        end_ns = clock.now_ns() + ns(timeout_s)
        next_ns = end_ns if self._ends_ns is not None else self._last_ns + period_ns
        clock.sleep_until(min(next_ns, end_ns))  # without it, the run's thread would ask all the time
        captured_ns = clock.now_ns() if self._ends_ns is None else self._ends_ns
        stamp_ns = captured_ns - captured_ns % period_ns
        if stamp_ns == self._last_ns:
            return None
        self._last_ns = stamp_ns
        height, width = self._size
        pixels = np.full(height * width * 3, stamp_ns // 1_000_000 % 256, np.uint8)
        return Image(Header(stamp_ns, self._ctx.name), height, width, "rgb8", 3 * width, pixels)

    @override
    def close(self) -> None:
        self._open = False


class FakeImu(Sensor):
    """An inertial sensor that measures at every control period of the clock.

    Args:
        ctx: provides the clock.
        turning: angular velocity about z [rad/s].
    """

    message_type: type[Message] = Imu

    def __init__(self, ctx: Context, turning: float = 0.5) -> None:
        self.topic = f"/fake/{ctx.name}/imu"
        self._ctx = ctx
        self._turning = turning
        self._open = False
        self._last_ns = -1
        self._ends_ns: int | None = None

    def silence(self) -> None:
        """The device stops capturing."""
        self._ends_ns = self._ctx.clock.now_ns()

    @override
    def open(self) -> None:
        self._open = True

    @override
    def read(self, timeout_s: float) -> Imu | None:
        if not self._open:
            raise SensorError(f"{self._ctx.name} is not open")
        clock, period_ns = self._ctx.clock, self._ctx.period_ns
        end_ns = clock.now_ns() + ns(timeout_s)
        next_ns = end_ns if self._ends_ns is not None else self._last_ns + period_ns
        clock.sleep_until(min(next_ns, end_ns))  # without it, the run's thread would ask all the time
        captured_ns = clock.now_ns() if self._ends_ns is None else self._ends_ns
        stamp_ns = captured_ns - captured_ns % period_ns
        if stamp_ns == self._last_ns:
            return None
        self._last_ns = stamp_ns
        return Imu(Header(stamp_ns, self._ctx.name), angular_velocity=Vector3(0.0, 0.0, self._turning))

    @override
    def close(self) -> None:
        self._open = False


class FakeTeleop(Teleop):
    """A device whose deadman (`pressed`), velocity and buttons are attributes. `activate` releases the deadman."""

    def __init__(self, ctx: Context) -> None:
        self._names = ctx.robot.joint_names
        self._open = False
        self._positions = np.zeros(len(self._names))
        self._last_ns = 0
        self.pressed = False
        self.silent = False
        """Whether the deadman is not reported."""
        self._let_go = False
        self.velocity = 0.0
        """Velocity of all joints [rad/s]."""
        self.events: tuple[OperatorEvent, ...] = ()
        """Buttons of the next command."""

    @override
    def connect(self) -> None:
        self._open = True

    @override
    def disconnect(self) -> None:
        self._open = False

    @override
    def activate(self, measured: JointReading) -> None:
        self._positions = measured.position.copy()
        self._last_ns = measured.stamp_ns
        self.pressed = self._let_go = False

    def press(self) -> None:
        """Let go of the deadman and press it."""
        self.pressed = self._let_go = True

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if not self._open:
            raise TeleopError("the fake device is not connected")
        self._positions = self._positions + self.velocity * seconds(measured.stamp_ns - self._last_ns)
        self._last_ns = measured.stamp_ns
        events, self.events = self.events, ()
        if self._let_go:
            self.deadman.report(False, measured.stamp_ns)
        self._let_go = False
        if not self.silent:
            self.deadman.report(self.pressed, measured.stamp_ns)
        allowed = self.deadman.allows(measured.stamp_ns) if self.operated else self.pressed
        if not allowed:
            self._positions = measured.position.copy()
        positions = dict(zip(self._names, self._positions.tolist(), strict=True)) if allowed else None
        return TeleopCommand(positions, events=events)


class FakePolicy(Policy):
    """Moves every joint towards a position drawn for each episode, in chunks of ten."""

    def __init__(self, ctx: Context) -> None:
        names = ctx.robot.joint_names
        self.spec = PolicySpec({"observation.state": (len(names),)}, names, len(names), chunk_size=10)
        self._goal = np.zeros(len(names))

    @override
    def reset(self, seed: int) -> None:
        self._goal = np.random.default_rng(seed).uniform(-0.5, 0.5, self.spec.action_size)

    @override
    def identity(self) -> str:
        return "a fake"

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        seen = {key: frame.observation(key, shape) for key, shape in self.spec.observations.items()}
        return {"state": seen["observation.state"].astype(np.float64), "goal": self._goal}

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        state = np.asarray(tensors["state"], np.float64)
        return {"delta": np.asarray(tensors["goal"], np.float64) - state, "state": state}

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        shares = np.linspace(0.1, 1.0, self.spec.chunk_size)[:, None]
        return np.asarray(tensors["state"], np.float64) + shares * np.asarray(tensors["delta"], np.float64)


class FakeEngine(Engine):
    """The model in this process."""

    def __init__(self, ctx: Context, mode: str = "fake") -> None:
        super().__init__(mode, ctx.seed)
        assert ctx.model is not None
        self.model = ctx.model

    @override
    def start(self) -> None:
        self.model.policy.load()
        self.stats.weights = self.model.policy.weights()
        self.stats.alive = True

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        return self.model.policy.infer(tensors)


class FakeSource(SourceWorker):
    """Commands nothing: the executors hold."""

    def __init__(self, session: StreamingRun, mode: ControlMode) -> None:
        super().__init__(session, mode, "holds")

    @override
    def begin_mode(self, seed: int) -> None:
        pass

    @override
    def work(self, timeout_s: float) -> None:
        self.pause(timeout_s)


class FakeViewer(Viewer):
    """Keeps the newest message on `/joint_states`; `person_closed` stands for the window's close button."""

    def __init__(self, ctx: Context) -> None:
        if ctx.bus is None:
            raise ValueError("a viewer needs the host's bus")
        self._bus = ctx.bus
        self._subscription: Subscription | None = None
        self.shown: Message | None = None
        self.person_closed = False

    @override
    def open(self) -> None:
        self._subscription = self._bus.subscribe("/joint_states", depth=1)

    @override
    def update(self) -> bool:
        received = self._subscription.get() if self._subscription is not None else None
        if received is not None:
            self.shown = received.message
        return not self.person_closed

    @override
    def close(self) -> None:
        if self._subscription is not None:
            self._subscription.close()
            self._subscription = None
