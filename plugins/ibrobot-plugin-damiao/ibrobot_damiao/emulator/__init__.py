"""Emulated Damiao motors: `motors` has what they do, `serve` an adapter for other programs."""

from ibrobot_damiao.emulator.motors import EmulatedMotor, EmulatedMotors

__all__ = ["EmulatedMotor", "EmulatedMotors"]
