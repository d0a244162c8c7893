"""The component of the section `tool_pose`: the pose of the tool, from the measured joints."""

from __future__ import annotations

from typing import override

from ibrobot_core.api import JOINT_STATES, NS_PER_S, Header, JointState, Pose, PoseStamped, Vector3
from ibrobot_core.app import CONTROL, RunView, SessionWorker
from ibrobot_kinematics import KinematicModel, KinematicsError, robot_model
from ibrobot_kinematics.options import ToolPoseOptions
from ibrobot_kinematics.poses import orientation


class ToolPose(SessionWorker):
    """Publishes the pose of the tool in the base frame."""

    urgent = True

    def __init__(self, options: ToolPoseOptions, session: RunView) -> None:
        super().__init__(session, "tool_pose", f"the tool's pose on {options.topic}", (CONTROL,))
        self._options = options
        self._period_ns = round(NS_PER_S / options.rate_hz)
        self._next_ns: int | None = None
        self._model: KinematicModel | None = None

    @override
    def setup(self) -> None:
        try:
            self._model = robot_model(self.session.config.robot)
        except KinematicsError as error:
            self.session.log.warning("%s is not published: %s", self._options.topic, error)
            return
        self._next_ns = None
        self._states = self.session.bus.subscribe(JOINT_STATES, 1)
        self.on_end.callback(self._states.close)

    @override
    def work(self, timeout_s: float) -> None:
        if self._model is None:
            self.pause(timeout_s)
            return
        received = self._states.get(timeout_s)
        if received is None:
            return
        state = received.message
        assert isinstance(state, JointState)
        stamp_ns = state.header.stamp_ns
        if self._next_ns is not None and self._next_ns - self._period_ns < stamp_ns < self._next_ns:
            return
        due_ns = self._next_ns if self._next_ns is not None else stamp_ns
        # Poses are on a grid of the rate; a gap, or a clock that was set back, starts a new grid.
        late = not 0 <= stamp_ns - due_ns < self._period_ns
        self._next_ns = (stamp_ns if late else due_ns) + self._period_ns
        tip = self._model.forward(state.position)
        pose = Pose(Vector3(*tip.position.tolist()), orientation(tip.rotation))
        self.session.bus.publish(self._options.topic, PoseStamped(Header(stamp_ns, self._options.frame), pose))
