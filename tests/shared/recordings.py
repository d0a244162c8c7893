"""Episodes made for tests: a contract of two joints' states, commands and two cameras, and bags of it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.recorder import McapRecorder
from ibrobot_testing.contexts import host_context
from numpy.typing import NDArray

from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract.specs import ActionPart, Contract, ObservationPart
from ibrobot_core.interfaces import EpisodeEnd, EpisodeStart, Feature
from ibrobot_core.messages import Float64MultiArray, Header, Image, JointState, String
from ibrobot_core.schema import Align, ImageSpec

START_NS = 1_700_000_000_000_000_000
JOINTS = ("pan", "lift", "gripper")
BLOCK = 32
SIZE = (3 * BLOCK, 4 * BLOCK)
CAMERAS = ("top", "wrist")
CONTRACT = Contract(
    30.0,
    (
        ObservationPart(
            "observation.state", "/joint_states", JointState.ros_type, tuple(f"position.{j}" for j in JOINTS), None,
            Align(), Feature("float32", (3,), tuple(f"{j}.pos" for j in JOINTS)),
        ),
        *(
            ObservationPart(
                f"observation.images.{camera}", f"/{camera}", Image.ros_type, (), ImageSpec(),
                Align("asof", tol_ms=200.0), Feature("image", (*SIZE, 3), ("height", "width", "channels")),
            )
            for camera in CAMERAS
        ),
    ),
    (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),),
)  # fmt: skip
RATES = {"/joint_states": 100, "/commands": 50, "/top": 30, "/wrist": 24}


def numbered(number: int) -> NDArray[np.uint8]:
    """A picture of blocks that are others for each number, so that no codec can hide which one it is."""
    shape = (SIZE[0] // BLOCK, SIZE[1] // BLOCK, 3)
    blocks = np.random.default_rng(number).choice(np.array([30, 220], np.uint8), shape)
    return blocks.repeat(BLOCK, 0).repeat(BLOCK, 1)


def record(
    folder: Path,
    seed: int,
    seconds: float,
    prompt: str = "",
    *,
    outcome: str = "success",
    contract: Contract | None = CONTRACT,
    gap: Mapping[str, tuple[float, float]] | None = None,
    stamped: Mapping[str, Callable[[float], float]] | None = None,
    commanders: Sequence[tuple[float, str]] = (),
    chunk_size: int = 1 << 20,
    **metadata: str,
) -> None:
    """Record streams of their own rates, stamped ahead of their receipt by a few jittered milliseconds.

    Args:
        folder: the episode's.
        seed: of the jitter, positions and pictures.
        seconds: how long it is.
        prompt: the task.
        outcome: how it ends.
        contract: what its metadata says; None for no contract there.
        gap: topic -> from when to when [s] it is silent.
        stamped: topic -> its header's stamp [s] for a message of this time [s], both since the beginning.
        commanders: from when on [s] who commands, as the topic `/commander` says with each state.
        chunk_size: of the file [bytes].
        metadata: more of it.
    """
    rng = np.random.default_rng(seed)
    recorder = McapRecorder(McapOptions(chunk_size=chunk_size), host_context(clock=SteppedClock(START_NS)))
    metadata |= {"prompt": prompt, "robot_type": "so101_follower"}
    if contract is not None:
        metadata["contract"] = json.dumps(contract.canonical())
    folder.parent.mkdir(parents=True, exist_ok=True)
    topics = dict(CONTRACT.topics) | ({"/commander": String.ros_type} if commanders else {})
    recorder.begin(EpisodeStart(folder, START_NS, topics, metadata))
    events: list[tuple[int, str, Any]] = []
    for topic, rate in RATES.items():
        begin, end = (gap or {}).get(topic, (0.0, 0.0))
        for i in range(int(seconds * rate)):
            stamp = START_NS + round(i * 1e9 / rate)
            received = stamp + int(rng.integers(0, 9_000_000))
            if stamped and topic in stamped:
                stamp = START_NS + round(stamped[topic](i / rate) * 1e9)
            if topic == "/joint_states":
                message: Any = JointState(Header(stamp), JOINTS, rng.uniform(-1, 1, size=3))
            elif topic == "/commands":
                message = Float64MultiArray(rng.uniform(-1, 1, size=3))
            else:
                pixels = numbered(seed * 1000 + i + (500 if topic == "/wrist" else 0))
                message = Image(Header(stamp), *SIZE, "rgb8", SIZE[1] * 3, pixels.ravel())
            if not begin <= i / rate < end:
                events.append((received, topic, message))
            if topic == "/joint_states" and commanders:
                who = [word for since, word in commanders if since <= i / rate][-1]
                events.append((received, "/commander", String(who)))
    for received, topic, message in sorted(events, key=lambda event: event[0]):
        recorder.write(topic, message, received)
    recorder.end(EpisodeEnd(START_NS + round(seconds * 1e9), outcome))
    recorder.close()
