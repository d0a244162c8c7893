"""The panel of servos: temperature, voltage, current and load of each."""

from __future__ import annotations

import math

from ibrobot_core.app import RunView

_QUANTITIES = {"temperature": "{:.0f} °C", "voltage": "{:.1f} V", "current": "{:.2f} A", "load": "{:.0%}"}


def servo_rows(session: RunView) -> list[tuple[str, ...]]:
    """One row for each joint of the arms on servo buses; values that no servo has sent yet are `-`."""
    state, config = session.state, session.config
    if state is None or config.simulated:
        return []
    values: dict[str, list[float]] = {}
    begin = 0
    for topic, size in session.signals:
        values[topic] = state.signals[begin : begin + size].tolist()
        begin += size
    rows = []
    for name, part in config.hardware.items():
        if part.type != "feetech_so101":
            continue
        columns = [values.get(f"/{name}/{quantity}", []) for quantity in _QUANTITIES]
        for i, joint in enumerate(part.joints or config.robot.joint_names):
            cells = (
                text.format(column[i]) if i < len(column) and math.isfinite(column[i]) else "-"
                for column, text in zip(columns, _QUANTITIES.values(), strict=True)
            )
            rows.append((joint, *cells))
    return rows
