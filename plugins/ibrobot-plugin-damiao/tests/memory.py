"""A CAN bus in memory: frames reach emulated motors, and their answers come back, within the call."""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar, override

import can
from ibrobot_damiao.emulator import EmulatedMotors


class MemoryBus(can.BusABC):
    """A bus of python-can, of interface type `memory`; its channel names the motors in `wires`."""

    wires: ClassVar[dict[str, MemoryBus.Wire]] = {}

    class Wire:
        """Motors on a bus, and what is wrong with it."""

        def __init__(self, motors: EmulatedMotors) -> None:
            self.motors = motors
            self.gone = False
            self.lose: set[int] = set()
            """Motors whose next answers are lost, once each."""
            self.frame_ns = 0
            """How long a frame takes, by the motors' stepped clock."""
            self.pending: deque[can.Message] = deque()
            self.frames: list[can.Message] = []
            """What a driver has sent."""

    def __init__(self, channel: str, **options: Any) -> None:
        self._wire = self.wires[channel]
        if self._wire.gone:
            raise can.CanInitializationError("no such device")
        self._can_protocol = can.CanProtocol.CAN_20
        super().__init__(channel, **options)

    @override
    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        wire = self._wire
        if wire.gone:
            raise can.CanOperationError("Network is down")
        wire.frames.append(msg)
        wire.motors.clock.sleep_until(wire.motors.clock.now_ns() + wire.frame_ns)
        for arbitration_id, data in wire.motors.receive(msg.arbitration_id, bytes(msg.data)):
            if (motor := arbitration_id - 0x10) in wire.lose:
                wire.lose.discard(motor)
                continue
            wire.pending.append(
                can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False, is_fd=msg.is_fd)
            )

    @override
    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self._wire.gone:
            raise can.CanOperationError("Network is down")
        return (self._wire.pending.popleft() if self._wire.pending else None), True
