"""An emulated arm whose joints are simulated: the servos' goals drive the physics, and its joints the encoders."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import numpy as np

from ibrobot_core.api import Context, EpisodeSetup, IbrobotError, RealClock, SimulatedHardware, ns
from ibrobot_core.app import Registry, RobotConfig
from ibrobot_feetech.arm import Arm
from ibrobot_feetech.emulator.pty import Emulator
from ibrobot_feetech.emulator.signals import SignalServer
from ibrobot_feetech.ticks import TICKS_PER_RADIAN


class PhysicsArm:
    """Advances a simulation in real time, coupled to the servos of an emulator, from `start` to `stop`.

    Args:
        config: a robot with a `simulation` section.
        registry: the installed plugins.
        arm: maps servos to joints.
        emulator: the emulator whose servos it moves.
        socket: path at which the simulation's signals are served.
        seed: seed of the scene.

    Raises:
        IbrobotError: if the simulation cannot be created.
    """

    def __init__(
        self, config: RobotConfig, registry: Registry, arm: Arm, emulator: Emulator, socket: Path, seed: int
    ) -> None:
        assert config.simulation is not None
        self._clock = RealClock()
        self._period_ns = ns(1.0 / config.control.rate_hz)
        ctx = Context(
            "emulator", self._clock, logging.getLogger("ibrobot.emulator"), config.robot, joints=arm.joints,
            period_ns=self._period_ns, seed=seed, simulation=config.simulation.options,
        )  # fmt: skip
        hardware = registry.create("hardware", config.simulation.type, config.simulation.options, ctx)
        assert isinstance(hardware, SimulatedHardware)
        self._hardware = hardware
        self._arm = arm
        self._emulator = emulator
        self._seed = seed
        self._server = SignalServer(socket, hardware.signals)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulated physics", daemon=True)
        self.error: IbrobotError | None = None
        """The error that ended the simulation, if any."""
        self.success: bool | None = None
        """Whether the scene's task is done; None if it has no task."""

    def start(self) -> None:
        """Set up the scene, move the servos to its joints' positions, and start."""
        self._hardware.connect()
        self._hardware.reset(EpisodeSetup(self._seed))
        self._place()
        for servo in self._emulator.servos.values():
            servo.set("goal_position", servo.get("present_position"))
        self._thread.start()

    def stop(self) -> None:
        """Stop; raises any error of the simulation."""
        self._ended.set()
        self._thread.join()
        self._server.close()
        self._hardware.disconnect()
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        deadline = self._clock.now_ns()
        try:
            while not self._ended.is_set():
                deadline = max(deadline + self._period_ns, self._clock.now_ns() - self._period_ns)
                self._clock.sleep_until(deadline)
                self._step()
        except IbrobotError as error:
            self.error = error

    def _step(self) -> None:
        hardware, emulator = self._hardware, self._emulator
        with emulator.lock:
            servos = [emulator.servos[servo] for servo in self._arm.servos]
            torque = np.array([servo.torque for servo in servos])
            goals = np.array([servo.goal - servo.get("homing_offset") for servo in servos])
        if torque.any():
            # A joint without torque follows its measured position.
            here = hardware.read().position
            hardware.write(np.where(torque, self._arm.radians(goals), here))
        else:
            hardware.relax()
        hardware.advance(self._period_ns)
        self._place()
        self._server.publish(hardware)
        self.success = hardware.success()

    def _place(self) -> None:
        """Set the encoders to the positions of the simulated joints."""
        reading = self._hardware.read()
        arm = self._arm
        ticks = arm.positions(reading.position)
        speeds = np.rint(reading.velocity * arm.sign * TICKS_PER_RADIAN)
        with self._emulator.lock:
            for servo, tick, speed in zip(arm.servos, ticks, speeds, strict=True):
                emulated = self._emulator.servos[servo]
                emulated.drive(float(tick) + emulated.get("homing_offset"), float(speed))
