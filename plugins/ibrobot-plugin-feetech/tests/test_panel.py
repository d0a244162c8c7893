"""The panel of servos, from the signals of a run."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from ibrobot_feetech import ibrobot_panels

(PANEL,) = ibrobot_panels()
QUANTITIES = ("temperature", "voltage", "current", "load")


def run(*, simulated: bool = False) -> Any:
    """A run of an arm with two servos, beside other hardware with a signal."""
    signals = [("/base/odometry", 1), *((f"/arm/{name}", 2) for name in QUANTITIES)]
    values = [7.0, 31.0, np.nan, 7.4, 7.5, 0.12, 0.0, 0.25, -0.5]
    parts = {
        "base": SimpleNamespace(type="wheels", joints=("left",)),
        "arm": SimpleNamespace(type="feetech_so101", joints=("elbow", "gripper")),
    }
    config = SimpleNamespace(simulated=simulated, hardware=parts)
    state = SimpleNamespace(signals=np.array(values))
    return cast("Any", SimpleNamespace(config=config, state=state, signals=signals))


def test_each_servo_has_a_row() -> None:
    assert PANEL.make(run()) == [
        ("elbow", "31 °C", "7.4 V", "0.12 A", "25%"),
        ("gripper", "-", "7.5 V", "0.00 A", "-50%"),
    ]
    assert all(len(row) == len(PANEL.columns) for row in PANEL.make(run()))


def test_a_simulation_has_no_servos() -> None:
    assert list(PANEL.make(run(simulated=True))) == []
