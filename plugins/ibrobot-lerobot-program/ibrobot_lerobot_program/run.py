"""The run under a program of LeRobot's, in a process of its own: answers its requests, until it ends or dies.

Started by `ProgramLink` as `python -m ibrobot_lerobot_program.run CHANNEL`. The run has its own control
process. If the program dies or goes silent, the arm holds.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Mapping
from typing import Any, override

import numpy as np

from ibrobot_core.api import Contract, IbrobotError, Vector, ns
from ibrobot_core.app import (
    CONTROL,
    Channel,
    ComponentFailed,
    ControlMode,
    FrameSampler,
    LaunchRequest,
    RobotConfig,
    Runtime,
    Session,
    SourceWorker,
    StreamingRun,
    error_text,
    find_config,
    installed_plugins,
    load_config,
    run_child,
)
from ibrobot_lerobot_program.features import RobotFeatures

MODE = "lerobot"
"""The control mode that is added: a program commands the executors of the contract's actions."""
READY, ANSWER = "ready", "answer"
_GLANCE_S = 0.1
_FIRST_FRAME_S = 10.0
"""How long the first observation may take [s]."""
_LOG = logging.getLogger("ibrobot.lerobot")


def load_robot(order: Mapping[str, Any]) -> RobotConfig:
    """The robot YAML that an order names, with the mode `lerobot`.

    Raises:
        IbrobotError: if it has faults, or no action that follows setpoints.
    """
    path = find_config(order["config"], installed_plugins())
    plain = load_config(path, overrides=order["overrides"], sim=order["sim"])
    executors = list(dict.fromkeys(spec.executor for spec in plain.contract.actions))
    if not executors:
        raise ComponentFailed(f"{path}: contract.actions is empty: LeRobot's actions need one")
    added = f"control_modes.{MODE}={{executors: [{', '.join(executors)}]}}"
    return load_config(path, overrides=[*order["overrides"], added], sim=order["sim"], mode=MODE)


class ProgramSource(SourceWorker):
    """Commands what the program sends, and gives it observations.

    A command counts until the executors' `stale_timeout`; then the arm holds where it is.
    """

    session: StreamingRun
    urgent = True
    autonomous = True

    def __init__(self, session: StreamingRun, mode: ControlMode, channel: Channel, features: RobotFeatures) -> None:
        super().__init__(session, mode, "a program of LeRobot's", (CONTROL,))
        self._channel = channel
        self._features = features
        self._contract = Contract.from_config(session.config)
        self._columns = session.config.robot.indices(features.joints)
        self._sampler: FrameSampler | None = None
        self._sent: dict[str, float] = {}
        """Joint -> the position that was sent last [rad]; empty before the first action of the mode."""
        self._sent_ns = 0
        """When it was sent [ns]."""
        executors = session.config.executors
        self._stale_ns = ns(min(executors[name].options.stale_timeout for name in mode.executors))
        self._refused = ""
        """Why an action was refused since the last answer."""

    @override
    def begin_mode(self, seed: int) -> None:
        self._sampler = FrameSampler(self._contract, self.session.bus)
        self._sent = {}

    @override
    def end_mode(self) -> None:
        if self._sampler is not None:
            self._sampler.close()
            self._sampler = None

    @override
    def work(self, timeout_s: float) -> None:
        requests = self._channel.receive(min(timeout_s, _GLANCE_S))
        with self.lock:
            for request in requests:
                self._answer(request)
        if self._channel.closed and not requests:
            _LOG.warning("the program of LeRobot's is gone; the run ends")
            self.session.finish()

    def _answer(self, request: Mapping[str, Any]) -> None:
        """Carry a request out; only one to read has an answer, with the error of an action before it."""
        if request["do"] == "end":
            self.session.finish()
        elif request["do"] == "act":
            try:
                self._act(request["action"])
            except IbrobotError as error:
                self._refused = error_text(error)
        else:
            try:
                self._observe()
            except IbrobotError as error:
                self._channel.send({"event": ANSWER, "error": error_text(error)})

    def _act(self, action: Mapping[str, float]) -> None:
        """Command joints; those without a position keep the one that they were sent last, unless it is stale."""
        session, positions = self.session, self._features.radians(action)
        if not self.active:
            raise ComponentFailed("the robot takes no actions now: its mode is not entered")
        joints, limits = self._features.joints, session.config.robot
        now_ns = session.clock.now_ns()
        if not self._sent or now_ns - self._sent_ns >= self._stale_ns:  # the arm has braked since
            self._sent = dict(zip(joints, session.measured().position[self._columns].tolist(), strict=True))
        self._sent |= positions
        self._sent_ns = now_ns
        wanted = np.clip(
            [self._sent[joint] for joint in joints], limits.lower[self._columns], limits.upper[self._columns]
        )
        session.send_plan(now_ns, self._contract.step_ns, joints, wanted[None])

    def _observe(self) -> None:
        """Send positions, as measured now, and the newest pictures."""
        session = self.session
        if session.faults:
            raise ComponentFailed(f"fault: {session.faults[-1]}")
        refused, self._refused = self._refused, ""
        if refused:
            raise ComponentFailed(f"an action was refused: {refused}")
        deadline_s = time.monotonic() + _FIRST_FRAME_S
        while True:
            assert self._sampler is not None
            frame = self._sampler.sample(session.bus.snapshot_ns())
            pictures = {name: frame.values.get(f"observation.images.{name}") for name in self._features.pictures}
            missing = [name for name, value in pictures.items() if value is None]
            if not missing:
                break
            if time.monotonic() > deadline_s:
                raise ComponentFailed(f"no picture of {', '.join(missing)} within {_FIRST_FRAME_S:g} s")
            time.sleep(0.005)
        position: Vector = session.measured().position[self._columns]
        self._channel.send(
            {"event": ANSWER, "values": self._features.values(position)},
            *(memoryview(np.ascontiguousarray(picture)) for picture in pictures.values()),
        )


def run(channel: Channel, order: Mapping[str, Any]) -> None:
    """Run with the program's channel."""
    config = load_robot(order)
    features = RobotFeatures.of_config(config, use_degrees=order["use_degrees"], calibration=order["calibration"])
    request = LaunchRequest(
        seed=order["seed"], source=lambda session, mode: ProgramSource(session, mode, channel, features)
    )
    runtime = Runtime(Session(config, installed_plugins(), request))
    runtime.start()
    try:
        channel.send({"event": READY})
        while not runtime.wait(_GLANCE_S):
            pass
    finally:
        runtime.stop()
    runtime.raise_failure()
    for line in runtime.session.outcome.holding:
        _LOG.warning("%s", line)


if __name__ == "__main__":
    sys.exit(run_child(run))
