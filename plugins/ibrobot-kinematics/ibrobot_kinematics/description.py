"""The component of the section: publishes the description and the frames, as robot_state_publisher does."""

from __future__ import annotations

from pathlib import Path
from typing import override

from ibrobot_core.api import JOINT_STATES, JointState, String, TFMessage
from ibrobot_core.app import CONTROL, RunView, SessionWorker
from ibrobot_kinematics.errors import KinematicsError
from ibrobot_kinematics.frames import mounted, transform
from ibrobot_kinematics.urdf import MOVING, read_urdf


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise KinematicsError(f"{path}: cannot be read as UTF-8 text: {error}") from None


class DescriptionPublisher(SessionWorker):
    """Publishes the moving links with every joint state if anybody subscribes; the rest once, latched."""

    def __init__(self, session: RunView) -> None:
        urdf = session.config.robot.description.urdf
        source = "the mounts of sensors" if urdf is None else urdf.name
        super().__init__(session, "description", f"/tf, /tf_static and /robot_description from {source}", (CONTROL,))

    @override
    def setup(self) -> None:
        session = self.session
        description = session.config.robot.description
        known = {name: i for i, name in enumerate(session.config.robot.joint_names)}
        urdf = read_urdf(description.urdf) if description.urdf is not None else None
        joints = urdf.joints if urdf is not None else ()
        moving = [joint for joint in joints if joint.type in MOVING]
        self._moving = [(joint, known[joint.name]) for joint in moving if joint.name in known]
        if unknown := [joint.name for joint in moving if joint.name not in known]:
            names = ", ".join(unknown)
            session.log.warning("no /tf for %s: not among robot.joints, but in %s", names, description.urdf)
        now_ns = session.clock.now_ns()
        fixed = [transform(joint, 0.0, now_ns) for joint in joints if joint.type == "fixed"]
        mounts = [each for frame in mounted(session.config) for each in frame.transforms(now_ns)]
        session.bus.publish("/tf_static", TFMessage((*fixed, *mounts)), latched=True)
        files = {"/robot_description": description.urdf, "/robot_description_semantic": description.srdf}
        for topic, path in files.items():
            if path is not None:
                session.bus.publish(topic, String(_text(path)), latched=True)
        self._states = session.bus.subscribe(JOINT_STATES, 1)
        self.on_end.callback(self._states.close)

    @override
    def work(self, timeout_s: float) -> None:
        received = self._states.get(timeout_s)
        if received is None or not self._moving or not self.session.bus.has_subscribers("/tf"):
            return
        state = received.message
        assert isinstance(state, JointState)
        positions = state.position.tolist()
        stamp_ns = state.header.stamp_ns
        transforms = tuple(transform(joint, positions[i], stamp_ns) for joint, i in self._moving)
        self.session.bus.publish("/tf", TFMessage(transforms))
