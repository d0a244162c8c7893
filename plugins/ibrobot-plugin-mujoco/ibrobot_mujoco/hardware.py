"""The robot in MuJoCo as hardware: servos with latency, noise, limits and injected faults, in the run's time."""

from __future__ import annotations

from collections import deque
from typing import override

import attrs
import mujoco
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import (
    Context,
    EpisodeSetup,
    HardwareError,
    JointReading,
    Signal,
    SimulatedHardware,
    Torque,
    Vector,
    ns,
)
from ibrobot_mujoco.faults import Faults
from ibrobot_mujoco.model import build_world
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import read_parameters
from ibrobot_mujoco.setpoints import Servos
from ibrobot_mujoco.state import OBJECTS_TOPIC, PHYSICS_TOPIC, POSE_SIZE, SCENE_TOPIC, physics_size, write_physics

_RELAXED = int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)


@attrs.frozen(eq=False)
class _Sample:
    """Joint positions measured by the servos at a time of the episode."""

    time_ns: int
    position: Vector
    velocity: Vector
    effort: Vector


class MujocoHardware(SimulatedHardware):
    """The joints of an MJCF. The constructor builds the model, so that `signals` are known before `connect`.

    Raises:
        HardwareError: if the MJCF, or a joint or position actuator in it, is missing.
    """

    def __init__(self, options: MujocoOptions, ctx: Context) -> None:
        self.joints = ctx.joints
        self._options = options
        self._ctx = ctx
        self._built, self._scene = build_world(options, ctx.robot, visual=False)
        self._model = model = self._built.model
        self._physics: mujoco.MjData | None = None
        self._qpos = _addresses(model, ctx.joints, model.jnt_qposadr)
        self._dofs = _addresses(model, ctx.joints, model.jnt_dofadr)
        self._servos = _servos(model, ctx.joints)
        self._start = _start_pose(options, ctx)
        self._faults = Faults(options.faults, ctx.joints)
        self._latency_ns = ns(options.latency)
        self._timestep_ns = ns(options.timestep)
        parameters = read_parameters(options.parameters, ctx.robot) if options.parameters is not None else None
        self._setpoints = Servos.of(parameters, ctx.joints, options)
        self._delay_ns = self._latency_ns + ns(parameters.delay if parameters is not None else 0.0)
        size, values = physics_size(self._built, self._scene), self._scene.values
        physics = Signal(PHYSICS_TOPIC, size, "stamp, state and factors, for cameras and viewers")
        scene = Signal(SCENE_TOPIC, len(values), f"{', '.join(values)} [m, base frame]")
        free = [name for name, thing in options.objects.items() if thing.mass is not None]
        self._objects = [int(model.joint(name).qposadr[0]) for name in free]
        objects = Signal(OBJECTS_TOPIC, POSE_SIZE * len(free), f"pose of each of {', '.join(free)}: position, wxyz")
        self.signals = (physics, *([scene] if values else ()), *([objects] if free else ()))

    @override
    def connect(self) -> None:
        self._physics = self._built.data
        self.reset(EpisodeSetup(self._ctx.seed))

    @override
    def disconnect(self) -> None:
        self._physics = None

    @override
    def reset(self, episode: EpisodeSetup) -> None:
        model, physics = self._model, self._connected()
        model.opt.disableflags &= ~_RELAXED
        mujoco.mj_resetData(model, physics)
        every_joint = self._ctx.robot.joint_names
        physics.qpos[_addresses(model, every_joint, model.jnt_qposadr)] = self._start
        physics.ctrl[_servos(model, every_joint)] = self._start
        rng = np.random.default_rng(episode.seed)
        self._noise = rng.spawn(1)[0]
        self._drawn = self._scene.begin(self._built, rng)
        self.factors = dict(zip(self._scene.factors, self._drawn.tolist(), strict=True))
        mujoco.mj_forward(model, physics)
        self._faults.restart()
        self._now_ns = self._stepped_ns = 0
        self._stamp_ns = self._ctx.clock.now_ns()
        self._target: Vector = physics.ctrl[self._servos]
        self._setpoints.restart(self._target)
        self._commands: deque[tuple[int, Vector | None]] = deque()
        self._samples = deque([self._sample()])
        self._last: JointReading | None = None

    @override
    def read(self) -> JointReading:
        self._connected()
        self._stamp_ns = self._ctx.clock.now_ns()
        if self._faults.active("read_error", self._now_ns):
            raise HardwareError(f"{self._ctx.name}: reading failed (injected fault read_error)")
        if self._faults.active("silent", self._now_ns):
            if self._last is None:
                raise HardwareError(f"{self._ctx.name}: no joint has ever answered (injected fault silent)")
            return attrs.evolve(self._last, stale=True)
        while len(self._samples) > 1 and self._samples[1].time_ns <= self._now_ns - self._latency_ns:
            self._samples.popleft()
        sample = self._samples[0]
        noise = self._noise.normal(0.0, self._options.noise, len(self.joints)) if self._options.noise else 0.0
        position = sample.position + noise
        self._last = JointReading(self._stamp_ns, position, sample.velocity.copy(), sample.effort.copy())
        return self._last

    @override
    def write(self, position: Vector) -> None:
        self._connected()
        if position.shape != (len(self.joints),) or not np.isfinite(position).all():
            raise HardwareError(f"{self._ctx.name}: a command is {len(self.joints)} finite angles, got {position}")
        self._send(position.copy())

    @override
    def relax(self) -> Torque:
        """Switch off the torque of every servo in the model."""
        self._connected()
        return Torque.OFF if self._send(None) else Torque.UNKNOWN

    def _send(self, command: Vector | None) -> bool:
        """Send a command (None: torque off); returns False if the bus is silent and loses it."""
        if self._faults.active("silent", self._now_ns):
            return False
        self._commands.append((self._now_ns + self._delay_ns, command))
        return True

    @override
    def reset_faults(self) -> None:
        self._connected()
        self._faults.clear(self._now_ns)

    @override
    def advance(self, step_ns: int) -> None:
        physics = self._connected()
        end_ns = self._now_ns + step_ns
        frozen = self._faults.frozen(self._now_ns)
        # The remainder of a step that is not a multiple of the timestep is added to the next one.
        while self._stepped_ns + self._timestep_ns <= end_ns:
            self._drive(physics, frozen)
            mujoco.mj_step(self._model, physics)
            self._stepped_ns += self._timestep_ns
            if self._latency_ns:
                self._samples.append(self._sample())
        if not self._latency_ns:
            self._samples[0] = self._sample()
        self._now_ns = end_ns
        self._stamp_ns += step_ns

    def _drive(self, physics: mujoco.MjData, frozen: list[int]) -> None:
        """Receive the commands that have arrived, and move the servos' setpoints towards the last one."""
        while self._commands and self._commands[0][0] <= self._stepped_ns:
            command = self._commands.popleft()[1]
            if command is None:
                self._model.opt.disableflags |= _RELAXED
                continue
            if self._model.opt.disableflags & _RELAXED:
                self._model.opt.disableflags &= ~_RELAXED
                self._setpoints.restart(physics.qpos[self._qpos])
            command[frozen] = self._target[frozen]
            self._target = command
        physics.ctrl[self._servos] = self._setpoints.step(self._target)

    def _sample(self) -> _Sample:
        physics = self._connected()
        position, velocity = physics.qpos[self._qpos], physics.qvel[self._dofs]
        return _Sample(self._stepped_ns, position, velocity, physics.qfrc_actuator[self._dofs])

    @override
    def success(self) -> bool | None:
        self._connected()
        return self._scene.success(self._built)

    @override
    def read_signal(self, index: int, out: Vector) -> None:
        physics = self._connected()
        if index >= len(self.signals):
            raise HardwareError(f"no signal {index}, there are {len(self.signals)}")
        topic = self.signals[index].topic
        if topic == PHYSICS_TOPIC:
            write_physics(self._built, self._drawn, self._stamp_ns, out)
        elif topic == SCENE_TOPIC:
            self._scene.observe(self._built, out)
        else:
            for number, address in enumerate(self._objects):
                first = POSE_SIZE * number
                out[first : first + POSE_SIZE] = physics.qpos[address : address + POSE_SIZE]

    def _connected(self) -> mujoco.MjData:
        if self._physics is None:
            raise HardwareError(f"{self._ctx.name} is not connected")
        return self._physics


def _addresses(model: mujoco.MjModel, joints: tuple[str, ...], table: NDArray[np.int32]) -> NDArray[np.intp]:
    return np.array([table[model.joint(name).id] for name in joints], dtype=np.intp)


def _servos(model: mujoco.MjModel, joints: tuple[str, ...]) -> NDArray[np.intp]:
    """The actuators that drive `joints`; their names in the MJCF may differ."""
    driven = {
        int(model.actuator_trnid[i, 0]): i
        for i in range(model.nu)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
    }
    return np.array([driven[model.joint(name).id] for name in joints], dtype=np.intp)


def _start_pose(options: MujocoOptions, ctx: Context) -> Vector:
    """Positions of all joints at the beginning of an episode [rad], in robot order."""
    try:
        return ctx.robot.pose(options.start_pose)
    except KeyError as error:
        raise HardwareError(f"simulation.start_pose: {error.args[0]}") from error
