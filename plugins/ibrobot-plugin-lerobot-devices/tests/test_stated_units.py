"""No unit is guessed: whatever a device of LeRobot's or of another package says, or does not."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ibrobot_lerobot_devices import library
from ibrobot_lerobot_devices.units import UNITS, Choices, Mapped, UnitProblem, map_axes, map_joints

MODULES = {"lerobot.robots.arm": True, "lerobot_robot_other": False, "my_lerobot.robots": False, "lerobots": False}
"""Module of the code that moves a device -> whether it is LeRobot's own."""
FEATURES = ("pan.pos", "pan.q", "x.vel", "theta.vel", "theta.dq", "linear.vel")
BUSES = (None, "degrees", "range_m100_100", "range_0_100", "ticks")
"""The unit of the motor; None: no bus."""
GIVEN: tuple[dict[str, str], ...] = ({}, *({name: unit} for name in ("*", "pan", "theta", "x") for unit in UNITS))
CASES = list(itertools.product(MODULES, FEATURES, BUSES, GIVEN))
LIMITS = {"pan": (-1.0, 1.0), "x": (-1000.0, 1000.0), "theta": (-1000.0, 1000.0), "linear": (-1.0, 1.0)}
ONE = {"degrees": np.pi / 180, "radians": 1.0, "metres": 1.0, "range_m100_100": 0.01, "range_0_100": 0.02}
"""Unit -> what one of it is, of a joint whose limits are -1 and 1."""


def make_device(module: str, feature: str, unit: str | None) -> Any:
    """A device with one feature, whose code is in `module`, and whose motor has a unit."""

    def send_action(self: Any, action: Any) -> None:
        """Do nothing."""

    send_action.__module__ = module
    device: Any = type("Device", (), {"send_action": send_action})()
    device.action_features = {feature: float}
    if unit is not None:
        motor = SimpleNamespace(norm_mode=SimpleNamespace(value=unit))
        device.bus = SimpleNamespace(motors={feature.partition(".")[0]: motor}, disable_torque=None)
    return device


def expected_unit(own: bool, feature: str, bus: str | None, given: dict[str, str]) -> str:
    """The unit that somebody has stated; empty if nobody has."""
    base, _, end = feature.partition(".")
    if end in ("pos", "q"):
        stated = given.get(base) or bus or ("radians" if own and end == "q" else "") or given.get("*", "")
        return stated if stated in UNITS else ""
    stated = given.get(base) or ({"x": "metres", "theta": "degrees"}.get(base, "") if own else "")
    return stated if stated in ("metres", "degrees", "radians") else ""


def mapped(module: str, feature: str, bus: str | None, given: dict[str, str]) -> Mapped:
    motors, base = library.motors(make_device(module, feature, bus)), feature.partition(".")[0]
    choices = Choices({}, given, "pose", (), ())
    if feature.endswith((".pos", ".q")):
        return map_joints([feature], motors, choices, [base], LIMITS)[0]
    return map_axes([feature], motors, choices, [base])[0]


def test_a_device_has_the_unit_that_a_person_states_or_does_not_move() -> None:
    refused = 0
    for module, feature, bus, given in CASES:
        unit = expected_unit(MODULES[module], feature, bus, given)
        if not unit:
            refused += 1
            with pytest.raises(UnitProblem, match=r"LeRobot does not say the unit of .*: give it as units: "):
                mapped(module, feature, bus, given)
            continue
        found = mapped(module, feature, bus, given)
        assert found.unit == unit, (module, feature, bus, given)
        assert found.scale.factor == pytest.approx(ONE[unit]), (module, feature, bus, given)
    assert (len(CASES), refused) == (2520, 1465)
