"""Perception: one worker per peripheral publishes the messages of its sensor."""

from __future__ import annotations

from collections import deque
from typing import override

from ibrobot_core.component import SessionWorker
from ibrobot_core.interfaces import Sensor
from ibrobot_core.interfaces.run_state import SensorFigures
from ibrobot_core.launch.session import Session
from ibrobot_core.schema import PeripheralConfig
from ibrobot_core.units import seconds

_RATE_WINDOW = 31
"""Number of messages over which the rate is measured."""


class SensorWorker(SessionWorker):
    """Opens a sensor and publishes its messages; ready after the first message, or when it has no receiver to serve."""

    session: Session
    urgent = True
    ready_timeout_s = 30.0

    def __init__(self, session: Session, peripheral: PeripheralConfig, needs: tuple[str, ...]) -> None:
        super().__init__(session, f"sensor:{peripheral.name}", f"{peripheral.kind} {peripheral.type}", needs)
        self._peripheral = peripheral
        self._sensor: Sensor | None = None
        self._received = 0
        self._stamps: deque[int] = deque(maxlen=_RATE_WINDOW)

    @override
    def setup(self) -> None:
        sensor = self._sensor = self.session.make("sensor", self._peripheral, self._peripheral.name)
        self.on_end.callback(sensor.close)
        sensor.open()
        for topic, message in sensor.latched():
            self.session.bus.publish(topic, message, latched=True)

    @override
    def work(self, timeout_s: float) -> None:
        assert self._sensor is not None
        if (message := self._sensor.read(timeout_s)) is None:
            return
        self.session.bus.publish(self._sensor.topic, message)
        now_ns = self.session.clock.now_ns()
        self._stamps.append(now_ns)
        self._received += 1
        if (elapsed_s := seconds(self._stamps[-1] - self._stamps[0])) > 0:
            header = getattr(message, "header", None)
            age_s = seconds(now_ns - header.stamp_ns) if header is not None else None
            figures = SensorFigures(self._received, (len(self._stamps) - 1) / elapsed_s, age_s)
            self.session.sensors[self._peripheral.name] = figures

    @override
    def is_ready(self) -> bool:
        return bool(self._stamps) or (self._sensor is not None and self._sensor.idle)

    @override
    def not_ready(self) -> str:
        return f"no message on {self._sensor.topic if self._sensor else 'its topic'}"
