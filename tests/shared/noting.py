"""An emulated servo that keeps its goal positions."""

from __future__ import annotations

from ibrobot_feetech.emulator import EmulatedServo


class Noting(EmulatedServo):
    """Keeps its goals while its torque is on, each as it is written: several may come at once to a slow emulator."""

    def __init__(self, servo: int) -> None:
        self.goals: list[int] = []
        super().__init__(servo)

    def write(self, address: int, content: bytes) -> None:
        super().write(address, content)
        if self.torque:
            self.goals.append(self.get("goal_position"))
