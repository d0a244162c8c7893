"""The simulated arm, fed with recorded commands: the model that the simulation builds, without contacts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from weakref import WeakKeyDictionary

import attrs
import mujoco
import numpy as np
from ibrobot_kinematics.mjcf import delete_unused_meshes
from mujoco import rollout

from ibrobot_core.api import Robot, Vector
from ibrobot_mujoco.identification.recordings import Recording
from ibrobot_mujoco.model import apply_parameters, build_spec
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import ArmParameters, JointParameters, read_parameters
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.setpoints import Servos

_STEP_S = 0.004
"""Least step of the physics: shorter ones take longer, and differ by less than an encoder shows."""
WINDOW_S = 10.0
"""A recording is simulated in windows, each from the measured state, so that processors share them."""
_SPEED_ROWS = 2
"""Measurements on each side from which the speed at the beginning of a window follows."""


@attrs.frozen(eq=False)
class _Window:
    """A part of a recording on the grid of the physics' steps."""

    begin: int
    """First step, counted from the beginning of the recording."""
    steps: int
    start: Vector
    """Measured position and speed at the beginning, shape (2, J)."""
    rows: slice
    """Its measurements."""


class FedArm:
    """The arm as the simulation of a robot YAML builds it, alone and without contacts, fed with recorded commands.

    Args:
        options: the simulation.
        robot: the robot.
        threads: number of threads.

    Raises:
        HardwareError: if the arm cannot be simulated.
    """

    def __init__(self, options: MujocoOptions, robot: Robot, threads: int = 1) -> None:
        self.robot = robot
        step = max(options.timestep, _STEP_S)
        self.options = attrs.evolve(options, scene=scene("empty"), objects={}, cameras=(), faults=(), timestep=step)
        self._spec, _ = build_spec(attrs.evolve(self.options, parameters=None), robot)
        self._spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for geom in list(self._spec.geoms):
            if geom.parent.explicitinertial or geom.parent.name == "world":
                self._spec.delete(geom)
        delete_unused_meshes(self._spec)
        model = self._spec.compile()
        self._datas = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._joints = robot.joint_names
        self._qpos = np.array([model.joint(name).qposadr[0] for name in self._joints])
        self._dofs = np.array([model.joint(name).dofadr[0] for name in self._joints])
        driven = {int(model.actuator_trnid[i, 0]): i for i in range(model.nu)}
        self._servos = np.array([driven[model.joint(name).id] for name in self._joints])
        self._step_s = float(model.opt.timestep)
        self._states = np.empty((0, 0, 0))
        self._limited: WeakKeyDictionary[Recording, Vector] = WeakKeyDictionary()
        """Commands on the grid, with the speed limit of the servos."""
        self.original = self.present = self._parameters_of(model)
        """The parameters of the MJCF with the options, and those of the present file, if there is one."""
        if options.parameters is not None:
            self.present = read_parameters(options.parameters, robot)

    def _parameters_of(self, model: mujoco.MjModel) -> ArmParameters:
        """The parameters that the model has by itself."""
        joints = {}
        for name, servo, dof in zip(self._joints, self._servos, self._dofs, strict=True):
            limited = bool(model.actuator_forcelimited[servo])
            joints[name] = JointParameters(
                kp=float(model.actuator_gainprm[servo, 0]),
                damping=float(np.ravel(model.dof_damping[dof])[0] - model.actuator_biasprm[servo, 2]),
                frictionloss=float(model.dof_frictionloss[dof]),
                armature=float(model.dof_armature[dof]),
                torque_limit=float(model.actuator_forcerange[servo, 1]) if limited else None,
            )
        carried = float(model.body_gravcomp[1:].mean()) if model.nbody > 1 else 0.0
        return ArmParameters(schema=1, robot=self.robot.name, gravity_compensation=carried, joints=joints)

    def windows(self, recording: Recording, length_s: float = WINDOW_S) -> list[_Window]:
        """Divide a recording."""
        times, measured = recording.times, recording.measured
        count = max(1, round(recording.seconds / length_s))
        edges = np.linspace(0, len(times), count + 1).astype(int)
        windows = []
        for first, last in pairwise(edges):
            begin = int(np.ceil(times[first] / self._step_s - 1e-6))
            near = slice(max(0, first - _SPEED_ROWS), first + _SPEED_ROWS + 1)
            span = times[near] - times[near].mean()
            speed = span @ (measured[near] - measured[near].mean(axis=0)) / max(float(span @ span), 1e-9)
            steps = int(np.ceil(times[last - 1] / self._step_s)) - begin + 1
            windows.append(_Window(begin, steps, np.stack([measured[first], speed]), slice(first, last)))
        return windows

    def _commands(self, recording: Recording, parameters: ArmParameters) -> tuple[Vector, Vector]:
        """Commands at the steps of the physics, before the delay, and the times of these steps [s]."""
        count = int(np.ceil(recording.seconds / self._step_s)) + 2
        first_s = float(recording.command_times[0])
        before = max(0, int(np.ceil(-first_s / self._step_s)))
        times = np.arange(-before, count, dtype=np.float64) * self._step_s
        if recording not in self._limited:
            newest = np.searchsorted(recording.command_times, times + 1e-9, side="right") - 1
            held = recording.commands[np.maximum(newest, 0)]
            self._limited[recording] = Servos.of(None, self._joints, self.options).steps(held)
        limited = self._limited[recording]
        backlash = np.array([parameters.joints[name].backlash for name in self._joints])
        bias = np.array([parameters.joints[name].bias for name in self._joints])
        commands: Vector = with_backlash(limited, backlash) + bias
        return commands, times

    def _delay(self, parameters: ArmParameters) -> float:
        """Time from a command to its effect on a reading, without the arm [s]."""
        return parameters.delay + 2 * self.options.latency

    def _controls(self, recording: Recording, windows: Sequence[_Window], parameters: ArmParameters) -> list[Vector]:
        commands, times = self._commands(recording, parameters)
        steps = np.arange(max(each.begin + each.steps for each in windows)) * self._step_s - self._delay(parameters)
        delayed = np.stack([np.interp(steps, times, column) for column in commands.T], axis=1)
        return [delayed[each.begin : each.begin + each.steps] for each in windows]

    def run(
        self, parameters: ArmParameters | None, recordings: Sequence[Recording], length_s: float = WINDOW_S
    ) -> list[Vector]:
        """The simulated positions at the times of the measurements of each recording [rad], shape (M, J).

        Args:
            parameters: of the arm; None for the servos of the MJCF as they are, whose damping may be a torque that
                counts towards their limit.
            recordings: whose commands it gets.
            length_s: about how long it is simulated from a measured state; infinite for once, from the first one.
        """
        spec = self._spec.copy()
        if parameters is None:
            parameters = self.original
        else:
            apply_parameters(spec, parameters, self.robot)
        model = spec.compile()
        listed = [(number, each) for number, one in enumerate(recordings) for each in self.windows(one, length_s)]
        controls = []
        for number, one in enumerate(recordings):
            own = [each for index, each in listed if index == number]
            controls += self._controls(one, own, parameters)
        longest = max(each.steps for _, each in listed)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        initial = np.zeros((len(listed), size))
        given = np.zeros((len(listed), longest, model.nu))
        for row, ((_, each), control) in enumerate(zip(listed, controls, strict=True)):
            initial[row, 1 + self._qpos] = each.start[0]
            initial[row, 1 + model.nq + self._dofs] = each.start[1]
            given[row, : each.steps, self._servos] = control.T
            given[row, each.steps :, self._servos] = control[-1][:, None]
        shape = (len(listed), longest, size)
        if self._states.shape != shape:
            self._states = np.empty(shape)  # kept, since new memory costs as much time as the simulation
        state, _ = self._rollout.rollout(model, self._datas, initial, given, state=self._states)
        reached = state[:, :, 1 + self._qpos]
        results = [np.empty_like(one.measured) for one in recordings]
        for row, (number, each) in enumerate(listed):
            one = recordings[number]
            # The state after step n is at time (begin + n + 1) * step; the first one is where the window begins.
            path = np.concatenate([each.start[:1], reached[row, : each.steps]])
            times = (each.begin + np.arange(each.steps + 1)) * self._step_s
            asked = one.times[each.rows]
            results[number][each.rows] = np.stack([np.interp(asked, times, column) for column in path.T], axis=1)
        return results

    def torques(self, parameters: ArmParameters, recordings: Sequence[Recording]) -> tuple[Vector, Vector]:
        """What each servo needed without a limit.

        Returns:
            The largest torque [Nm], and the share of the measurements above the limit by a tenth; shape (J,) each.
        """
        kp = np.array([parameters.joints[name].kp for name in self._joints])
        limit = np.array([parameters.joints[name].torque_limit or np.inf for name in self._joints])
        needed = []
        for one, reached in zip(recordings, self.run(parameters, recordings), strict=True):
            commands, times = self._commands(one, parameters)
            asked = np.stack(
                [np.interp(one.times - self._delay(parameters), times, each) for each in commands.T], axis=1
            )
            needed.append(np.abs(kp * (asked - reached)))
        every = np.concatenate(needed)
        return every.max(axis=0), (every > 1.1 * limit).mean(axis=0)

    def close(self) -> None:
        """End the threads."""
        self._rollout.close()


def with_backlash(commands: Vector, backlash: Vector) -> Vector:
    """Commands after the gears, as `Servos` gives them [rad], shape (N, J).

    Args:
        commands: [rad], shape (N, J).
        backlash: lost motion of each joint [rad], shape (J,).
    """
    result = commands.copy()
    for joint in np.flatnonzero(backlash):
        result[:, joint] = _play(commands[:, joint], float(backlash[joint]) / 2)
    return result


def _play(column: Vector, half: float) -> Vector:
    moves = np.flatnonzero(np.diff(column, prepend=np.nan) != 0)
    held, values = float(column[0]), []
    for value in column[moves].tolist():
        held = min(max(held, value - half), value + half)
        values.append(held)
    counts = np.diff(np.append(moves, len(column)))
    return np.repeat(np.array(values), counts)


def seconds_of(recordings: Sequence[Recording]) -> float:
    """Their duration together [s]."""
    return sum(each.seconds for each in recordings)
