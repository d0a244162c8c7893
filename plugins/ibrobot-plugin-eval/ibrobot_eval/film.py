"""Film an episode: run it again with a camera that sees the whole scene. In lockstep, a camera changes nothing."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import CompressedImage, HardwareDescriptor, seconds
from ibrobot_core.app import (
    ComponentFailed,
    LaunchRequest,
    RobotConfig,
    Runtime,
    Session,
    find_config,
    installed_plugins,
    load_config,
)
from ibrobot_eval.episodes import Result, run_to_end, write
from ibrobot_eval.limits import Attempt, EpisodeTooLong
from ibrobot_eval.policies import Policy

_CAMERA = "evaluation_film"
_DEPTH = 10_000


def can_film(policy: Policy) -> bool:
    """Whether the simulation of a policy has a camera for films, and this machine can render."""
    config = _filmed(policy, None)
    return config is not None and all(each.name != _CAMERA for each in installed_plugins().absent_sensors(config))


def _filmed(policy: Policy, seed: int | None) -> RobotConfig | None:
    """The robot with the film camera; None if its simulation has none."""
    registry = installed_plugins()
    path = find_config(policy.config, registry)
    plain = load_config(path, overrides=policy.overrides_of(seed), mode=policy.mode, sim=True, registry=registry)
    assert plain.simulation is not None
    descriptor = registry.find("hardware", plain.simulation.type)
    if not isinstance(descriptor, HardwareDescriptor) or not descriptor.film:
        return None
    camera = {"name": _CAMERA, "kind": "camera", **descriptor.film}
    peripherals = json.dumps([*plain.document.get("peripherals", ()), camera], default=str)
    overrides = (*policy.overrides_of(seed), f"peripherals={peripherals}")
    config = load_config(path, overrides=overrides, mode=policy.mode, sim=True, registry=registry)
    return attrs.evolve(config, recording=None, viewer=None)


def film(file: Path, policy: Policy, result: Result, attempt: Attempt) -> None:
    """Run an episode again, within the limits of an attempt, and write a video of it.

    Raises:
        ComponentFailed: if it ends differently.
    """
    config = _filmed(policy, result.seed)
    assert config is not None
    runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, seed=result.seed, episodes=1)))
    session = runtime.session
    images = session.bus.subscribe(f"/camera/{_CAMERA}/image_raw", _DEPTH)
    try:
        run_to_end(runtime, attempt)
    except EpisodeTooLong as error:
        raise ComponentFailed(f"not filmed: {error}") from None
    time_s = round(seconds(session.clock.now_ns() - session.episodes.begun_ns), 6)
    if (bool(session.outcome.successes), time_s) != (result.success, result.time_s):
        ended = f"{'a success' if session.outcome.successes else 'a failure'} after {time_s:.2f} s"
        raise ComponentFailed(
            f"not filmed: repeated for its video, the episode ended in {ended}, not in {_ended(result)}: the policy is "
            "not deterministic, so that the command in the report may not repeat it either"
        )
    frames = images.drain()
    lasted_s = seconds(frames[-1].received_ns - frames[0].received_ns) if len(frames) > 1 else 1.0
    pictures = [each.message.data.tobytes() for each in frames if isinstance(each.message, CompressedImage)]
    write(file, encode(pictures, len(frames) / lasted_s))


def _ended(result: Result) -> str:
    return f"{'a success' if result.success else 'a failure'} after {result.time_s:.2f} s"


def encode(pictures: list[bytes], rate_hz: float) -> bytes:
    """Encode JPEG pictures as a video (MP4, H.264). Equal pictures give equal bytes."""
    import av

    buffer = io.BytesIO()
    decoder: Any = av.CodecContext.create("mjpeg", "r")
    with av.open(buffer, "w", format="mp4", options={"fflags": "+bitexact"}) as container:
        stream: Any = None
        for picture in pictures:
            for frame in decoder.decode(av.Packet(picture)):
                if stream is None:
                    # Otherwise, x264 reads memory that it has not written: 1 of 100 films had other bytes.
                    options = {"crf": "28", "preset": "veryfast", "threads": "1", "x264-params": "cpu-independent=1"}
                    stream = container.add_stream("libx264", rate=round(rate_hz), options=options)
                    stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, frame.format.name
                    stream.codec_context.colorspace = frame.colorspace
                frame.pts = None
                container.mux(stream.encode(frame))
        if stream is not None:
            container.mux(stream.encode(None))
    return buffer.getvalue()
