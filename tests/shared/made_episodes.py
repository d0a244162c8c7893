"""Small recordings for tests of what shows them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ibrobot_core.api import EpisodeEnd, EpisodeStart, Float64MultiArray, Header, Image, JointState, RealClock
from ibrobot_core.app import installed_plugins

START_NS = 1_700_000_000_000_000_000
STEP_NS = 20_000_000
JOINTS = "/joint_states"


def make_episode(
    path: Path,
    seconds: float = 1.0,
    *,
    joints: Sequence[str] = ("pan", "tilt"),
    cameras: Sequence[str] = ("top",),
    outcome: str = "success",
    signals: Mapping[str, Sequence[float]] | None = None,
    **metadata: Any,
) -> Path:
    """Record an episode at 50 Hz. Joint i moves by i + 1 rad/s; the pixels of pictures are the number of the tick.

    `signals`: topic -> vector that it has all the time.
    """
    from ibrobot_testing.contexts import host_context

    descriptor = installed_plugins().find("recorder", "mcap")
    recorder = descriptor.make(descriptor.options(), host_context(clock=RealClock()))
    topics = {JOINTS: JointState.ros_type, **{f"/camera/{name}/image_raw": Image.ros_type for name in cameras}}
    topics |= dict.fromkeys(signals or {}, Float64MultiArray.ros_type)
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    recorder.begin(EpisodeStart(path, START_NS, topics, texts))
    for tick in range(round(seconds * 1e9 / STEP_NS) + 1):
        stamp_ns = START_NS + tick * STEP_NS
        at_s = tick * STEP_NS / 1e9
        positions = np.array([at_s * (i + 1) for i in range(len(joints))])
        recorder.write(JOINTS, JointState(Header(stamp_ns), tuple(joints), positions), stamp_ns)
        for name in cameras:
            picture = Image(Header(stamp_ns), 16, 16, "rgb8", 48, np.full(768, tick, np.uint8))
            recorder.write(f"/camera/{name}/image_raw", picture, stamp_ns)
        for topic, vector in (signals or {}).items():
            recorder.write(topic, Float64MultiArray(np.array(vector)), stamp_ns)
    recorder.end(EpisodeEnd(START_NS + round(seconds * 1e9), outcome, {}))
    recorder.close()
    return path
