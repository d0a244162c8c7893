"""A bus in memory, with a stepped clock and six emulated motors."""

from __future__ import annotations

from collections.abc import Iterator

import can
import pytest
from ibrobot_damiao.emulator import EmulatedMotor, EmulatedMotors
from ibrobot_testing.contexts import START_NS

from ibrobot_core.api import SteppedClock

from .memory import MemoryBus


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryBus.Wire]:
    """Motors 1 to 6 on the channel `arm` of interface type `memory`; `wire.motors` has them."""
    monkeypatch.setattr("can.util.VALID_INTERFACES", {*can.VALID_INTERFACES, "memory"})
    monkeypatch.setitem(can.interfaces.BACKENDS, "memory", (MemoryBus.__module__, MemoryBus.__name__))
    motors = EmulatedMotors([EmulatedMotor(motor) for motor in range(1, 7)], SteppedClock(START_NS))
    MemoryBus.wires["arm"] = MemoryBus.Wire(motors)
    yield MemoryBus.wires["arm"]
    MemoryBus.wires.clear()


@pytest.fixture
def clock(wire: MemoryBus.Wire) -> SteppedClock:
    """The clock by which the motors turn."""
    clock = wire.motors.clock
    assert isinstance(clock, SteppedClock)
    return clock
