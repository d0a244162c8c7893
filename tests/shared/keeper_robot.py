"""The robot YAML of a simulated arm of two joints whose policy sees the joints and a sensor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml


def keeper_robot(folder: Path, policy: str, sensor: Mapping[str, Any], observation: Mapping[str, Any]) -> Path:
    """Write `tryout.yaml`; its recordings go to `bags` beside it.

    Args:
        folder: where it is written.
        policy: type of the model of its only mode.
        sensor: the sensor, an item of `peripherals`.
        observation: that of the sensor in the contract.
    """
    limits = {"lower": -1.0, "upper": 1.0, "max_velocity": 2.0, "max_acceleration": 10.0}
    joints = ("pan", "tilt")
    document = {
        "robot": {
            "name": "tryout",
            "joints": [{"name": each, **limits} for each in joints],
            "groups": {"all": [*joints]},
        },
        "simulation": {"type": "fake"},
        "peripherals": [dict(sensor)],
        "executors": {"joints": {"type": "position", "group": "all"}},
        "models": {"keeper": {"type": policy}},
        "control_modes": {"work": {"executors": ["joints"], "inference": {"model": "keeper"}}},
        "default_control_mode": "work",
        "recording": {"type": "mcap", "root": str(folder / "bags")},
        "contract": {
            "rate_hz": 20,
            "observations": [{"key": "observation.state", "topic": "/joint_states"}, dict(observation)],
            "actions": [{"key": "action", "executor": "joints", "topic": "/joints/commands"}],
        },
    }
    path = folder / "tryout.yaml"
    path.write_text(yaml.safe_dump(document, sort_keys=False))
    return path
