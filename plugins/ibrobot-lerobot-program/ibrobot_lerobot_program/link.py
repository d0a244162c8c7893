"""The program's side of a run of ibrobot under LeRobot: start it, read it, command it, end it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.app import ChannelMessage, Child, ComponentFailed
from ibrobot_lerobot_program.features import RobotFeatures
from ibrobot_lerobot_program.run import READY, load_robot

_MODULE = "ibrobot_lerobot_program.run"
_START_S = 120.0
_ANSWER_S = 20.0
_END_S = 20.0
"""How long the run may take to come to rest and end [s]."""


class ProgramLink:
    """A run of a robot YAML that a program commands in LeRobot's units.

    Args:
        config: robot YAML: a path, or the name of a shipped one.
        sim: whether to run its simulation.
        overrides: changes of it, as `--set` takes them.
        use_degrees: as in LeRobot's robots: degrees, or -100 to 100.
        calibration: name or path of a calibration; by default the hardware's.
        seed: seed of the simulation.

    Attributes:
        measured: joint -> position at the last `read` [rad].
    """

    newest: ClassVar[ProgramLink | None] = None
    """The one of this program that was started last, from which a teleoperator knows where the robot is."""

    def __init__(
        self, config: str, *, sim: bool, overrides: Sequence[str] = (), use_degrees: bool = True,
        calibration: str = "", seed: int = 0,
    ) -> None:  # fmt: skip
        self._order = {
            "config": config, "sim": sim, "overrides": list(overrides), "use_degrees": use_degrees,
            "calibration": calibration, "seed": seed,
        }  # fmt: skip
        self._child: Child | None = None
        self.measured: Mapping[str, float] = {}

    @cached_property
    def features(self) -> RobotFeatures:
        """The joints and pictures, also before `start`.

        Raises:
            IbrobotError: if the robot YAML has faults.
        """
        config = load_robot(self._order)
        return RobotFeatures.of_config(
            config, use_degrees=bool(self._order["use_degrees"]), calibration=str(self._order["calibration"])
        )

    @cached_property
    def robot_type(self) -> str:
        """LeRobot's name of the robot type, from the YAML."""
        robot = load_robot(self._order).robot
        return robot.robot_type or robot.name

    @property
    def is_running(self) -> bool:
        """Whether the run has been started and not ended."""
        return self._child is not None and self._child.alive

    def start(self) -> None:
        """Start the run.

        Raises:
            ComponentFailed: with the run's own error.
        """
        self._child = Child(_MODULE, self._order, end_s=_END_S)
        try:
            if self._message(_START_S)["event"] != READY:
                raise ComponentFailed("the run does not start")
            self.read()
        except ComponentFailed:
            self.end()
            raise
        ProgramLink.newest = self

    def read(self) -> tuple[dict[str, float], dict[str, NDArray[np.uint8]]]:
        """Positions in LeRobot's units, and pictures: RGB, shape (H, W, C).

        Raises:
            ComponentFailed: for a fault of the robot, with its text, or if the run has ended.
        """
        self._running().channel.send({"do": "read"})
        answer = self._message(_ANSWER_S)
        if "error" in answer:
            raise ComponentFailed(answer["error"])
        pictures, begin = dict[str, NDArray[np.uint8]](), 0
        for name, shape in self.features.pictures.items():
            size = int(np.prod(shape))
            pictures[name] = np.frombuffer(answer.payload, np.uint8, size, begin).reshape(shape)  # writable
            begin += size
        self.measured = self.features.radians(answer["values"])
        return answer["values"], pictures

    def act(self, action: Mapping[str, object]) -> dict[str, float]:
        """Command positions in LeRobot's units, and return them; a fault is raised by the next `read`.

        Joints without a position keep the one that they were sent last, as with LeRobot's followers.

        Raises:
            ComponentFailed: for an unknown feature, or a value that is no finite number; nothing is commanded then.
        """
        wanted = self.features.numbers(action)
        self._running().channel.send({"do": "act", "action": wanted})
        return wanted

    def end(self) -> None:
        """End the run, and let the robot come to rest as its YAML says. Safe to call twice."""
        child, self._child = self._child, None
        if child is not None:
            child.channel.send({"do": "end"})
            child.channel.close()
            child.end()

    def _running(self) -> Child:
        if self._child is None:
            raise ComponentFailed("the run has not been started, or has ended")
        return self._child

    def _message(self, timeout_s: float) -> ChannelMessage:
        child = self._running()
        try:
            message = child.wait(timeout_s)
        except ComponentFailed as death:
            raise death if child.failure else ComponentFailed(f"the run has ended: {death}") from None
        if message is None:
            raise ComponentFailed(f"the run does not answer for {timeout_s:g} s")
        return message
