"""Teleop `scripted_operator`: an operator who takes the robot when a policy is about to fail, and picks the cube.

It knows the scene's ground truth, and moves as `scripted_pick` does. For `benchmarks/correct_policy.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import override

import attrs
import numpy as np
from ibrobot_mujoco.experts import EXPERTS
from ibrobot_mujoco.experts.expert import ACTION, SCENE, STATE
from ibrobot_mujoco.experts.options import ExpertOptions

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    Float64MultiArray,
    Frame,
    JointReading,
    Teleop,
    TeleopCommand,
    TeleopDescriptor,
    documented,
    hookimpl,
    option,
    seconds,
)

LIFTED_M = 0.045
"""A cube whose centre is higher is in the gripper."""


@documented
@attrs.frozen
class OperatorOptions:
    """Options of `type: scripted_operator`."""

    patience: float = option(3.5, unit="s", gt=0, help="time for the policy to lift the cube, and again to deliver it")


class ScriptedOperator(Teleop):
    """Watches the cube: not lifted in time, dropped or not delivered in time means that the policy is about to fail."""

    operated = False

    def __init__(self, options: OperatorOptions, ctx: Context) -> None:
        assert ctx.bus is not None
        self._options = options
        self._bus, self._joints = ctx.bus, ctx.robot.joint_names
        self._expert = EXPERTS[0].make(ExpertOptions(), ctx)
        self._scene = np.empty(0)
        self._taken = self._asked = self._commands = False
        """Whether it took the robot in this episode, waits for it, and commands it."""
        self._begin()

    def _begin(self) -> None:
        self._begun_ns: int | None = None
        self._lifted = False
        self._chunk, self._chunk_ns = np.empty((0, len(self._joints))), 0

    @override
    def connect(self) -> None:
        self._expert.load()
        self._scenes = self._bus.subscribe("/simulation/scene", 1)

    @override
    def disconnect(self) -> None:
        pass

    @override
    def activate(self, measured: JointReading) -> None:
        """The begin of an episode, or the takeover that was requested."""
        self._begin()
        self._expert.reset(0)
        if self._taken and self._asked:
            self._asked, self._commands = False, True
        else:
            self._taken = self._asked = self._commands = False

    @override
    def read(self, measured: JointReading) -> TeleopCommand:
        if (item := self._scenes.get()) is not None:
            assert isinstance(item.message, Float64MultiArray)
            self._scene = np.asarray(item.message.data)
        if not self._scene.size:
            return TeleopCommand(None)
        if self._commands:
            return TeleopCommand(dict(zip(self._joints, self._at(measured).tolist(), strict=True)))
        if not self._taken and self._fails(measured.stamp_ns):
            self._taken = self._asked = True
            return TeleopCommand(None, events=("intervention",))
        return TeleopCommand(None)

    def _fails(self, now_ns: int) -> bool:
        if self._begun_ns is None:
            self._begun_ns = now_ns
        lifted = bool(self._scene[2] > LIFTED_M)
        delivered = bool(np.linalg.norm(self._scene[:2] - self._scene[7:9]) < 0.07)
        if lifted and not self._lifted:
            self._lifted, self._begun_ns = True, now_ns
        dropped = self._lifted and not lifted and not delivered
        return dropped or (not delivered and seconds(now_ns - self._begun_ns) > self._options.patience)

    def _at(self, measured: JointReading) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        """The expert's position now [rad], shape (J,)."""
        rate = self._expert.spec.rate_hz or 30.0
        if measured.stamp_ns - self._chunk_ns >= NS_PER_S / rate:
            values = {STATE: measured.position.astype(np.float32), SCENE: self._scene.astype(np.float32)}
            tensors = self._expert.infer(self._expert.preprocess(Frame(measured.stamp_ns, values)))
            self._chunk, self._chunk_ns = np.asarray(tensors[ACTION]), measured.stamp_ns
        step = seconds(measured.stamp_ns - self._chunk_ns) * rate
        first, then = self._chunk[0], self._chunk[min(1, len(self._chunk) - 1)]
        position: np.ndarray[tuple[int, ...], np.dtype[np.float64]] = first + min(1.0, step) * (then - first)
        return position


@hookimpl
def ibrobot_teleop() -> Iterator[TeleopDescriptor]:
    """The operator."""
    yield TeleopDescriptor(
        "scripted_operator",
        ScriptedOperator,
        "takes over before a policy fails",
        OperatorOptions,
    )
